import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.ingest.footage import UnitFrames, read_unit, unit_frames
from worldpose.ingest.match_folder import read_match


def test_units_lie_on_the_matchs_clock(spec):
    # Clips span 5 to 8 and 9 to 11; cam2 runs 10 frames ahead; goal's own video starts at 0.
    clips = ((5, 3), (9, 2))
    assert unit_frames(spec, "cam1") == UnitFrames(first=5, count=6, offset=0, ranges=clips)
    assert unit_frames(spec, "cam2") == UnitFrames(first=5, count=6, offset=10, ranges=clips)
    assert unit_frames(spec, "goal") == UnitFrames(first=5, count=3, offset=-5, ranges=((5, 3),))


def test_a_static_camera_covers_all_clips_in_match_frames(match_folder, make_people):
    people, calibration = read_unit(read_match(match_folder), "cam1")
    np.testing.assert_array_equal(people.frame, [5, 6, 7, 9, 10])
    there = [0, 1, 2, 4, 5]  # nothing is kept of frame 8, which no clip has
    np.testing.assert_array_equal(people.keypoints, make_people(5, 6, seed=1).keypoints[there])
    assert calibration is not None
    assert calibration.id == "cam1"


def test_a_broadcast_camera_covers_its_clip(match_folder, make_people):
    # Clip goal starts at match frame 5; its video starts at frame 0.
    people, calibration = read_unit(read_match(match_folder), "goal")
    np.testing.assert_array_equal(people.frame, [5, 6, 7])
    np.testing.assert_array_equal(people.keypoints, make_people(0, 3, seed=3).keypoints)
    assert calibration is None


@pytest.mark.parametrize("unit_id", ["cam9", "main", "corner"])
def test_a_unit_without_detections_is_refused(match_folder, unit_id):
    with pytest.raises(InputError, match="those of cam1, cam2, goal"):
        read_unit(read_match(match_folder), unit_id)
