"""A viewer file opened from disk in a real browser without a network."""

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from chromium import IN_BROWSER, drive
from viewer_clips import mixed_clip

from worldpose.formats.viewer_file import write_viewer
from worldpose.video.files import write_video

pytestmark = [*IN_BROWSER, pytest.mark.timeout(1800)]
SCRIPT = Path(__file__).with_name("viewer_file_in_browser.mjs")
FRAMES = [0, 1, 31]


@pytest.fixture(scope="module")
def clip():
    """Half of the clip, from its 10th frame on, is in a video of every second frame."""
    video = {"camera": "north", "first": 110, "frames": 15, "step": 2}
    return replace(mixed_clip(), video=video)


@pytest.fixture(scope="module")
def seen(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewer")
    film = (np.full((90, 160, 3), 15 * k, np.uint8) for k in range(15))
    write_video(folder / "half.mp4", film, clip.fps / 2)
    page = (files("flows.reports") / "viewer.html").read_text()
    write_viewer(folder / "view.html", page, [clip], {"half": folder / "half.mp4"})
    task = {"file": str(folder / "view.html"), "frames": FRAMES, "video": True}
    task |= {"picture": str(folder / "plain.png"), "coloured": str(folder / "coloured.png")}
    return task | drive(SCRIPT, task, folder, 600)


def test_the_file_opens_offline_and_fits_its_screens(seen):
    assert seen["title"] == "m & n: half"
    assert seen["first_paint_ms"] is not None
    assert [seen[f"overflow_{width}"] for width in (1440, 1280, 390)] == [0, 0, 0]


def test_keys_move_through_time_colours_and_cameras_and_the_video_follows(seen):
    assert ((seen["last"], seen["stepped"]), seen["colours"]) == ((59, 1), "spread")
    assert seen["through"] == "broadcast"
    assert seen["played"] > 20
    assert seen["labels"] == [20, 1, 2]
    # Frame 20 of the clip is the 6th of the video, shown from 0.20 to 0.24 s.
    assert 0.2 < seen["video"] < 0.24


def test_people_are_blue_by_person_and_not_all_blue_by_uncertainty(seen):
    def count(path):
        b, g, r = cv2.imread(path).astype(int).transpose(2, 0, 1)
        blue, warm = (b > 1.2 * g) & (g > 1.5 * r) & (b > 60), (r > 1.3 * b) & (r > 90) & (r >= g)
        return blue.sum(), warm.sum()

    blue, warm = count(seen["picture"])
    assert blue > 100 and warm < 30
    assert count(seen["coloured"])[1] > 100
