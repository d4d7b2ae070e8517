"""Real moving cameras alone, with clicked key frames; skipped where the data is absent.

WORLDPOSE_TEST_DATA names a folder with `broadcast_clip` (run.py broadcast_clip --fetch),
and with `static_pair`, which moving cameras are cut out of.
"""

import csv

import numpy as np
import pytest
from command_line import succeed
from real_data import GIVEN, needs

DATA = GIVEN / "broadcast_clip"


@pytest.fixture(scope="module")
def bench():
    import real_cameras  # late: it loads the simulators

    return real_cameras


@pytest.fixture(scope="module")
def found(bench):
    return bench.calibrate(DATA)


@needs("broadcast_clip")
@pytest.mark.parametrize("name", ["drawn_first.json", "drawn_second.json"])
def test_lines_drawn_by_hand_in_further_frames_are_met_within_a_pixel(bench, found, name):
    drawn = bench.read_drawn(name)
    assert len(drawn.key_frames) == 6
    off = np.array([row[2] for row in bench.distances(found, bench.estimated_pitch(found), drawn)])
    assert len(off) > 150
    assert np.mean(np.abs(off)) < 0.4  # seen: 0.20 of 512 columns
    nominal = bench.distances(found, bench.PitchTemplate.standard(), drawn)
    assert np.mean([abs(row[2]) for row in nominal]) < 1.0  # seen: 0.87
    # The markings of the Laws on the surface that the clip shows.
    nominal = bench.distances(found, bench.estimated_surface(found), drawn)
    assert np.mean([abs(row[2]) for row in nominal]) < 1.0  # seen: 0.64


@needs("broadcast_clip")
def test_the_stated_error_covers_the_lines_that_miss(bench, found):
    rows = bench.distances(found, bench.estimated_pitch(found), bench.read_drawn(bench.FIRST))
    off, stated = (np.array([row[column] for row in rows]) for column in (2, 3))
    assert np.mean(np.abs(off) < 2.0 * np.hypot(stated, 0.3)) > 0.9
    # The main camera of a league stadium, at the halfway line.
    center, std = found.camera.center, np.sqrt(np.diag(found.uncertainty.clip))[:3]
    assert abs(center[0]) < 5.0
    assert 10.0 < center[2] < 25.0
    assert (std > [0.1, 0.1, 0.05]).all()


@pytest.mark.slow
@needs("broadcast_clip")
def test_the_clip_alone_gives_a_camera_and_people_on_the_pitch(bench, tmp_path):
    match, project = tmp_path / "match", ("--project", tmp_path / "project")
    match.mkdir()
    bench.write_match(DATA, match)
    succeed("run", match, *project, timeout=1800)
    export = ("export", "broadcast-clip", *project, "--format", "positions")
    succeed(*export, "--out", tmp_path / "out")
    with (tmp_path / "out/positions/goal.csv").open() as file:
        rows = list(csv.DictReader(file))
    people = {row["person"] for row in rows}
    by_frame = len(rows) / bench.FRAMES
    assert len(people) >= 10
    assert by_frame >= 10.0
    assert all(20.0 < float(row["x_m"]) < 55.0 for row in rows if row["frame"] == "25")


@pytest.mark.slow
@needs("static_pair")
def test_a_low_camera_with_a_short_lens_over_a_pitch_that_falls_to_its_ends(bench, tmp_path):
    """A camera 8 m up, unlike those of large stadiums that the prior has, on a club's pitch."""
    true = bench.cut_clip.write_moving_clip(GIVEN / "static_pair", "right", "both", tmp_path)
    found, lines = bench.calibrate_cut(tmp_path)
    center, off_lines, off_places = bench.errors_of_cut(found, lines, true)
    assert center < 0.5  # seen: 0.12
    assert off_lines.mean() < 2.0  # seen: 1.0 of 1280 columns
    assert np.median(off_places) < 4.0  # seen: 2.3
    assert 0.2 < found.report.pitch.surface[1] < 0.7
