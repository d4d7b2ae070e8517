import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation.recorded_files import read_bvh

ARM = """HIERARCHY
ROOT hip
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT upper
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT lower
    {
      OFFSET 0 0 5
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 2 0 0
      }
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.02
1 2 3 0 0 0  0 0 0  0 0 0
1 2 3 90 0 0  0 0 0  0 0 0
0 0 0 90 90 0  0 0 90  0 90 0
"""


def written(folder, text):
    path = folder / "clip.bvh"
    path.write_text(text)
    return path


def test_positions_are_those_worked_out_by_hand(tmp_path):
    capture = read_bvh(written(tmp_path, ARM))
    assert capture.names == ("hip", "upper", "lower", "lower_end")
    assert capture.fps == 50.0
    expected = [
        # Nothing turned: offsets add up.
        [[1, 2, 3], [1, 12, 3], [1, 12, 8], [3, 12, 8]],
        # A quarter turn about z takes y to -x and x to y.
        [[1, 2, 3], [-9, 2, 3], [-9, 2, 8], [-9, 4, 8]],
        # The root turns by Z then X: Rz Rx takes y to z, z to x and x to y, so (0, 10, 0) goes to
        # z. The upper joint's Ry takes z to x and x to -z, then the root x to y: (0, 0, 5) goes
        # along y. The lower's Rx leaves x, which Ry takes to -z and the root to -x.
        [[0, 0, 0], [0, 0, 10], [0, 5, 10], [-2, 5, 10]],
    ]
    np.testing.assert_allclose(capture.positions, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("HIERARCHY", "SKELETON", "'SKELETON' as word 1"),
        ("Frames: 3", "Frames: 4", "4 frames of 12 channels"),
        ("0.02", "0", "every 0 s"),
        ("OFFSET 0 10 0", "OFFSET 0 ten 0", "'ten'"),
        (
            "3 Zrotation Xrotation Yrotation",
            "3 Zrotation Xrotation Wrotation",
            "Wrotation of upper",
        ),
        ("1 2 3 0 0 0", "1 2 3 nan 0 0", "'nan'"),
        (ARM[ARM.index("lower") :], "", "ends too early"),
    ],
)
def test_what_is_wrong_is_said(old, new, found, tmp_path):
    with pytest.raises(InputError, match=found):
        read_bvh(written(tmp_path, ARM.replace(old, new, 1)))
