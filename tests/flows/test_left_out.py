"""A camera that cannot be calibrated is left out; the match continues with a warning."""

import json
import shutil

from command_line import TINY, succeed, worldpose
from filmed import write_filmed

from flows.reports.cameras import camera_table
from worldpose.ingest.match_folder import read_spec
from worldpose.store.store import open_run


def spoil(folder, camera):
    """Leave a camera two clicks, which determine nothing."""
    file = folder / "annotations" / "static_calibration" / f"{camera}.json"
    clicked = json.loads(file.read_text())
    clicked["points"], clicked["drawn"] = clicked["points"][:2], []
    file.write_text(json.dumps(clicked))


def test_a_match_with_a_camera_that_cannot_be_calibrated_is_complete_and_warns(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    spoil(folder, "cam01")
    project = tmp_path / "project"
    done = worldpose("run", folder, "--project", project, "--json")
    assert done.code == 0, done.err
    assert list(done.json["left_out"]) == ["cam01"]
    (warning,) = [text for text in done.json["warnings"] if "left out" in text]
    assert warning in " ".join(done.err.split())
    run = open_run(project, TINY)
    assert run.record.state == "complete"
    assert run.record.left_out == done.json["left_out"]
    cameras = run["tracking/clip"]["camera"].values.tolist()
    assert "cam01" not in cameras
    assert run["bundle_adjustment/cameras"]["camera"].values.tolist() == cameras
    assert run["body_fitting/clip"].sizes["person"] > 0

    status = succeed("status", "--project", project, "--json").json
    assert warning in status["matches"][0]["warnings"]
    page = tmp_path / "report.html"
    succeed("report", TINY, "--project", project, "--out", page)
    assert "camera cam01 is left out" in page.read_text()
    truth = ("--prediction", TINY, "--reference", tiny / "reference")
    scores = succeed("evaluate", *truth, "--project", project, "--json").json
    assert scores["coverage"] > 0.9
    assert scores["cameras"]["static"]["ground_error_median_m"] < 0.1
    out = tmp_path / "out"
    succeed("export", TINY, "--project", project, "--format", "worldpose", "--out", out)
    succeed("check", out)
    assert not list(out.rglob("*cam01*"))
    # Run again: nothing is computed, and the warning is not forgotten.
    again = succeed("run", folder, "--project", project, "--json").json
    assert (again["executed"], again["left_out"]) == (0, done.json["left_out"])


def test_a_match_with_one_usable_camera_is_partial_and_gates_ask_first(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    project = tmp_path / "project"
    names = sorted(f.stem for f in (folder / "annotations" / "static_calibration").iterdir())
    for camera in names[1:]:
        spoil(folder, camera)
    asked = worldpose("run", folder, "--project", project, "--gates", "auto", "--json")
    assert asked.code == 3, asked.err
    reasons = {each["unit"]: each["reasons"] for each in asked.json["reviews"]}
    assert "would be left out" in reasons[f"static_calibration/{names[1]}"][0]
    done = worldpose("run", folder, "--project", project, "--gates", "never", "--json")
    assert done.code == 4, done.err
    assert done.json["failed"] == 0
    assert done.json["blocked"] > 0
    assert sorted(done.json["left_out"]) == names[1:]
    assert f"1 of {len(names)} static cameras can be used ({names[0]})" in done.json["warnings"][-1]


def test_a_broken_video_leaves_its_camera_out_and_a_lost_one_hides_no_results(tmp_path):
    folder, project = tmp_path / "match", tmp_path / "project"
    dark = [9, 9, 9, 9]
    write_filmed(folder, {"a": dark, "b": dark, "c": dark}, [("clip", 0, 4)])
    file = folder / "videos" / "b.mp4"
    file.write_bytes(file.read_bytes()[:40])
    first = ("run", folder, "--project", project, "--until", "static_calibration", "--json")
    done = worldpose(*first)
    assert done.code == 0, done.err
    assert list(done.json["left_out"]) == ["b"]
    assert done.json["left_out"]["b"].startswith("b.mp4: expected a video file")

    keys = open_run(project, "filmed").record.results
    (folder / "videos" / "c.mp4").unlink()
    again = succeed(*first).json
    assert (again["executed"], open_run(project, "filmed").record.results) == (0, keys)
    assert succeed("status", folder, "--project", project, "--json").json["matches"]
    run = open_run(project, "filmed")
    rows = {row[0]: row[-1] for row in camera_table(run, read_spec(folder)).rows}
    assert rows["b"].startswith("left out: b.mp4")
