"""Clicked key frames of the broadcast camera: read back as written, or refused by place."""

import pytest

from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint
from worldpose.errors import InputError
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.writing import MatchAnnotations


def clicks(name="center_mark", xy=(640.0, 360.0)):
    return ClickedMarkings(points=(ClickedPoint(name=name, xy=xy),))


PICKED = KeyFrames(
    key_frames=(
        KeyFrame(frame=0, markings=clicks()),
        KeyFrame(frame=40, markings=clicks("corner_left_near", (3.5, 8.0))),
    )
)


@pytest.fixture
def write(write_tiny):
    def write(key_frames, clip="goal"):
        return write_tiny(annotations=MatchAnnotations(key_frames={clip: key_frames}))

    return write


def test_key_frames_are_read_as_written(write):
    assert read_match(write(PICKED)).key_frames == {"goal": PICKED}


def test_key_frames_of_something_else_are_refused(write):
    with pytest.raises(InputError, match=r"cam1\.json.*a clip with a broadcast camera: goal"):
        write(PICKED, clip="cam1")


@pytest.mark.parametrize("frames", [(4, 4), (9, 4)])
def test_frames_out_of_order_or_twice_are_refused(write, frames):
    picked = KeyFrames(key_frames=tuple(KeyFrame(frame=f, markings=clicks()) for f in frames))
    with pytest.raises(InputError, match=r"goal\.json: key_frames: .*rising order"):
        write(picked)


@pytest.mark.parametrize(
    ("markings", "place"),
    [
        (clicks("centre_mark"), r"key_frames\[0\]\.markings\.points\[0\]\.name.*center_mark"),
        (clicks(xy=(5000.0, 2.0)), r"key_frames\[0\]\.markings\.points\[0\]\.xy.*image of"),
        (ClickedMarkings(), r"key_frames\[0\]\.markings: .*Click some"),
    ],
)
def test_a_wrong_entry_is_named(write, markings, place):
    with pytest.raises(InputError, match=place):
        write(KeyFrames(key_frames=(KeyFrame(frame=3, markings=markings),)))
