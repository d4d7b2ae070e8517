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
    ("absent", "share", "longest"),
    [
        ({}, 0.0, ()),
        ({"one": (40, 63)}, 0.0, ()),  # under a second
        ({"one": (40, 64)}, 25 / 200, (140, 164, 7)),
        ({"one": (60, 99)}, 0.0, ()),  # left for good
        ({"both": (75, 99)}, 0.25, (175, 199)),
        ({"both": (0, 49), "two": (60, 89)}, 0.5, (100, 149)),
        ({"both": (0, 24), "two": (40, 95)}, 56 / 150, (140, 195, 9)),
    ],
)
def test_absences(absent, share, longest):
    names = ("absent_from_frame", "absent_to_frame", "absent_person")
    expected = {"absent_share": pytest.approx(share), **dict(zip(names, longest, strict=False))}
    assert measure_absences(clip(**absent), FRAME, [7, 9], 25.0) == expected


def test_a_clip_without_people_misses_them_all():
    assert measure_absences(np.zeros((100, 0), bool), FRAME, [], 25.0) == {"absent_share": 1.0}
