"""People who are missing for long are counted and named, short occlusions are not."""

import numpy as np
import pytest

from worldpose.tracking.absences import measure_absences

FRAME = np.arange(100, 200)


def clip(**absent):
    """Two people in 100 frames, 25 per second; rows in which one is not seen."""
    present = np.ones((100, 2), dtype=bool)
    for name, (first, last) in absent.items():
        present[first : last + 1, {"one": [0], "two": [1], "both": [0, 1]}[name]] = False
    return present


@pytest.mark.parametrize(
    ("absent", "share", "said"),
    [
        ({}, 0.0, []),
        ({"one": (40, 63)}, 0.0, []),  # under a second
        ({"one": (40, 64)}, 25 / 200, ["person 7 in frames 140 to 164"]),
        ({"one": (60, 99)}, 0.0, []),  # left for good
        ({"both": (75, 99)}, 0.25, ["all people in frames 175 to 199"]),
        (
            {"both": (0, 49), "two": (60, 89)},
            0.5,
            ["all people in frames 100 to 149", "person 9 in frames 160 to 189"],
        ),
    ],
)
def test_absences(absent, share, said):
    assert measure_absences(clip(**absent), FRAME, [7, 9], 25.0) == (pytest.approx(share), said)


def test_a_clip_without_people_misses_them_all():
    assert measure_absences(np.zeros((100, 0), bool), FRAME, [], 25.0) == (1.0, [])
