"""A match whose camera is calibrated without clicks, from its folder to the report."""

import shutil
from dataclasses import replace

import yaml
from command_line import TINY, succeed

from flows.registering import open_match
from flows.stages.broadcast_calibration import uncalibrated_warnings
from worldpose.formats.release_cameras import read_camera
from worldpose.ingest.footage import write_still
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch


def test_a_camera_without_clicks_has_its_place_in_the_report(tiny, tmp_path):
    folder, project = shutil.copytree(tiny, tmp_path / "match"), ("--project", tmp_path / "project")
    (folder / "annotations" / "static_calibration" / "cam00.json").unlink()
    true = read_camera(tiny / "reference" / "cameras" / "cam00.npz", (1920, 1080))
    x, y = true.center[:2] / [52.5, 34.0]
    ends, place = (("left", "right"), x) if abs(x) > abs(y) else (("near", "far"), y)
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    spec["cameras"][0] |= {"side": ends[int(place > 0.0)], "still": "stills/cam00.png"}
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    still = render_pitch(true, PitchTemplate.standard(), None, 1)
    write_still(folder / "stills" / "cam00.png", still)
    listed = succeed("ingest", folder, *project)
    assert "to be clicked" not in listed.out
    succeed("run", folder, *project, "--until", "triangulation")
    succeed("report", folder, *project, "--out", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "proposed markings" in page


def test_a_broadcast_video_that_nothing_calibrates_is_reported(store):
    match = open_match(store, TINY)
    assert uncalibrated_warnings(match) == ()
    videos = {"clip": match.folder.folder / "broadcast" / "clip.mp4"}
    (said,) = uncalibrated_warnings(replace(match, folder=replace(match.folder, videos=videos)))
    assert "of clip clip is not used: it needs clicks in" in said
