"""Cameras found without a click in real images and lines; skipped where the data is absent.

WORLDPOSE_TEST_DATA names a folder with `static_pair`, `wc14` and `sn22_lines`.
"""

import argparse

import numpy as np
import pytest
import static_pair
from common import run_in_process
from line_sets import RIGHT_PX, drawn_lines
from real_data import GIVEN, needs

from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.from_paint.proposal import calibrate_proposal, propose_camera
from worldpose.store.store import Store
from worldpose.video.folder import median_picture, open_video


@pytest.mark.slow
@needs("static_pair")
def test_a_wide_static_camera_is_found_without_a_click_and_without_its_lens():
    with open_video(GIVEN / "static_pair" / "right_camera.mp4") as video:
        pictures = (
            picture
            for number in range(0, 150, 15)
            for _, picture in video.frames(number, number + 1)
        )
        still = median_picture(pictures, 10)
    pitch = PitchTemplate.standard()
    found = calibrate_proposal(pitch, propose_camera(still, pitch, side="near"), still)
    # 39 clicks by hand place it at (-1.0, -49.4, 7.6) m.
    assert np.linalg.norm(found.estimate.camera.center - [-1.0, -49.4, 7.6]) < 0.5
    assert found.report.ground_error.median < 0.4  # seen: 0.26 m stated, 0.13 m from the clicked
    assert still.shape == (static_pair.SIZE[1], static_pair.SIZE[0], 3)


@pytest.mark.slow
@needs("static_pair")
def test_both_static_cameras_of_a_match_are_calibrated_from_their_videos_alone(tmp_path):
    # Guesses by the centre circle once crowded out those by three lines: the right one was refused.
    match, store = tmp_path / "match", Store.create(tmp_path / "project")
    static_pair.write_static_pair(
        GIVEN / "static_pair", match, first_frame=0, frame_count=40, clicked=False
    )
    name, (keys,) = run_in_process(store, match, "static_calibration", 1, {})
    units = [f"static_calibration/{side}" for side in static_pair.SIDES]
    left_out = [store.manifest(name, *unit.split("/"), keys[unit]).left_out for unit in units]
    assert left_out == [{}, {}]


@pytest.mark.slow
@needs("wc14", "sn22_lines")
def test_drawn_lines_without_names_give_their_cameras_and_no_wrong_one():
    options = argparse.Namespace(first=0, count=10, drop=0.2, clutter=4)
    outcomes = list(drawn_lines(GIVEN, options))
    accepted = [each for each in outcomes if each.accepted]
    assert len(accepted) >= 6
    assert max(each.error for each in accepted) < RIGHT_PX
