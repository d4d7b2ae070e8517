"""Shots of a programme that is cut together from rendered cameras, and a stretch cut out of it."""

import cv2
import numpy as np
import pytest
from camera_builders import look_at_camera
from turning_clip import film_empty_pitch

from worldpose.broadcast_calibration.shots import find_shots
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.video.files import VideoReader, index_frames, write_video
from worldpose.video.recordings import cut_video

SIZE = np.array([320, 180])
FPS = 10.0


def filmed(center, aims, focal):
    """Images of an empty pitch from a tripod."""
    cameras = Camera.stack([look_at_camera(center, (*aim, 0.0), focal, SIZE) for aim in aims])
    return list(film_empty_pitch(cameras, 3))


def sweep(begin, end, count):
    return [(x, -4.0) for x in np.linspace(begin, end, count)]


def wipe():
    """A growing disc: 0.8 s."""
    pictures = []
    for radius in range(20, 84, 8):
        picture = np.full((180, 320, 3), (30, 30, 160), np.uint8)
        cv2.circle(picture, (160, 90), radius, (220, 200, 40), -1)
        pictures.append(picture)
    return pictures


@pytest.fixture(scope="module")
def programme():
    """Names of what follows one another, and its images."""
    main = (0.0, -80.0, 16.0)
    shots = [
        ("main", filmed(main, sweep(-25.0, 15.0, 44), 600.0)),
        ("crowd", filmed((0.0, 0.0, 3.0), [(x, 700.0) for x in range(-300, 300, 30)], 500.0)),
        ("still", filmed(main, [(10.0, 5.0)] * 44, 650.0)),
        ("low", filmed((-52.0, -40.0, 2.0), [(x, 100.0) for x in range(-40, 44, 2)], 500.0)),
        ("wipe", wipe()),
        ("replay", filmed(main, sweep(0.0, 25.0, 44), 700.0)),
        ("wipe", wipe()),
        ("later", filmed(main, sweep(20.0, -20.0, 44), 600.0)),
        ("short", filmed(main, sweep(10.0, 30.0, 20), 600.0)),
    ]
    return shots, [picture for _, pictures in shots for picture in pictures]


@pytest.fixture(scope="module")
def found(programme):
    return list(find_shots(enumerate(programme[1]), FPS))


def test_shots_end_where_pictures_were_cut_together(programme, found):
    shots, _ = programme
    begins = np.cumsum([0, *(len(pictures) for _, pictures in shots)])
    expected = [
        (begin, len(pictures))
        for begin, (name, pictures) in zip(begins, shots, strict=False)
        if name != "wipe"
    ]
    assert [(shot.first, shot.count) for shot in found] == expected


def test_only_live_pans_of_the_main_camera_are_proposed(found):
    said = dict(
        zip(
            ["main", "crowd", "still", "low", "replay", "later", "short"],
            (shot.unfit for shot in found),
            strict=True,
        )
    )
    assert said["main"] == said["later"] == ()
    assert "too little grass" in said["crowd"]
    assert said["still"] == ("hardly a pan",)
    assert "too little grass" in said["low"]
    assert said["replay"] == ("between two wipes, as replays are",)
    assert "shorter than 4 s" in said["short"]


def test_a_stretch_is_cut_out_picture_for_picture(programme, tmp_path):
    video, cut = tmp_path / "programme.mp4", tmp_path / "cut.mp4"
    write_video(video, programme[1][:90], FPS)
    place = cut_video(video, 41, 70, cut)
    # A key frame a second: 10 images.
    assert (place, index_frames(cut).fps) == (41 % 10, pytest.approx(FPS))
    with VideoReader(video) as one, VideoReader(cut) as two:
        for number in range(29):
            assert np.array_equal(one.frame(41 + number), two.frame(place + number))
        small = dict(one.readable(40, 42, width=160))
        assert small[41].shape == (90, 160, 3)
        assert abs(small[41].mean() - one.frame(41).mean()) < 1.0
    with pytest.raises(InputError, match="90 pictures"):
        cut_video(video, 80, 91, tmp_path / "none.mp4")
