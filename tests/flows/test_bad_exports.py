"""An export that fails is one error and leaves nothing behind; strange results are written."""

import errno
import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from camera_builders import look_at_camera
from command_line import TINY, invoke, worldpose
from run_records import match_spec
from test_release_formats import match_folder, origin, restated, tracked

from data_contracts.release import EXPORT_FORMATS, EXPORT_PURPOSES
from flows.reports.report import write_report
from flows.results import export as export_module
from flows.results import outputs
from flows.results.best_results import Origin
from flows.results.export import CLASHING, COUNTED, EXPORTS, OF_CAMERAS, POSITION_FORMATS, export
from flows.results.outputs import OWNERS
from worldpose.errors import InputError, UsageError, WorldposeError
from worldpose.formats.joints_file import read_joints
from worldpose.geometry.lens_models import LensModel

__all__ = ["match_folder"]  # a fixture


def whole():
    """Return the results of a run: one static camera, the broadcast camera, two people."""
    results = tracked()
    inliers = np.ones((4, 2, 1, 17), np.bool_)
    results["triangulation__A_1"]["inliers"] = (("frame", "person", "camera", "joint"), inliers)
    results["triangulation__A_1"] = results["triangulation__A_1"].assign_coords(camera=["north"])
    results["triangulation__A_1"].attrs["changes"] = []
    results["broadcast_calibration__A_1"].attrs["pitch"] = None
    return results


def nobody():
    results = {n: d.isel(person=[]) if "person" in d.sizes else d for n, d in whole().items()}
    results["tracking__A_1"].attrs["tracks"] = []
    return results


def one_frame():
    every = whole().items()
    return {n: d if n.startswith("broadcast") else d.isel(frame=[0]) for n, d in every}


def without_joints():
    """Return results in which no joint of anybody is known."""
    results = {name: data.copy(deep=True) for name, data in whole().items()}
    for name in ("triangulation__A_1", "body_fitting__A_1"):
        results[name]["joints"][:] = np.nan
    results["body_fitting__A_1"]["transl"][:] = np.nan
    return results


CASES = {"nothing": dict, "nobody": nobody, "one frame": one_frame, "no joint": without_joints}


def test_no_entry_of_a_release_changes(tmp_path, monkeypatch):
    (tmp_path / "kinds.json").write_text('{"A": {"1": "plane"}}')
    outputs.record_owner(tmp_path, {}, "m", {"kinds.json: A": "m"})  # as before the release
    files = [SimpleNamespace(path="kinds.json")]
    manifest = SimpleNamespace(release="v1", match_id="m", clips={"A": None}, files=files)
    monkeypatch.setattr(outputs, "read_manifest", lambda _: manifest)
    draft = tmp_path / "draft.json"
    draft.write_text('{"A": {"1": "mixed"}, "B": {"1": "plane"}}')
    for owner in ("m", "other"):
        for force in (False, True):
            with pytest.raises(InputError, match="of release v1 of m"):
                outputs.own_whole(tmp_path, {"kinds.json": draft}, "A", (owner,), overwrite=force)
        outputs.own_whole(tmp_path, {"kinds.json": draft}, "B", (owner,), overwrite=False)


def test_lens_errors_are_of_cameras_and_kinds_of_clips(tmp_path):
    for name in ("kinds.json", "lens_errors.json"):
        (tmp_path / name).write_text('{"A": {"max_error_px": 1.0}}')
    outputs.record_owner(tmp_path, {"lens_errors.json": None}, "m")  # as an older version did
    draft = tmp_path / "draft.json"
    draft.write_text('{"A": {"max_error_px": 2.0}}')
    options = {"overwrite": False, "cameras": "A"}
    outputs.own_whole(tmp_path, {"kinds.json": draft}, "B", ("m",), **options)
    with pytest.raises(InputError, match="clip or camera of this name"):
        outputs.own_whole(tmp_path, {"lens_errors.json": draft}, "B", ("other",), **options)
    outputs.own_whole(tmp_path, {"lens_errors.json": draft}, "B", ("m",), **options)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("form", EXPORTS)
def test_strange_results_are_written_or_refused(match_folder, tmp_path, form, case):
    out = tmp_path / "out"
    try:
        written = export(origin(match_folder, **CASES[case]()), [form], out)
    except WorldposeError as error:
        assert "expected" in str(error)
        assert not out.exists(), "an error leaves nothing"
    else:
        assert case != "nothing"
        needs_nobody = form in (*POSITION_FORMATS, *OF_CAMERAS)
        assert case == "one frame" or needs_nobody, "nobody is written as joints"
        assert all(path.stat().st_size for path in written)
        there = sorted(path for path in out.rglob("*") if path.is_file())
        assert there == sorted([*written, out / OWNERS]), "no draft is left"


def test_joints_of_people_of_whom_none_has_a_body_are_written(match_folder, tmp_path):
    offsets = (("joint", "coordinate"), np.zeros((17, 3)))
    fits = without_joints()["body_fitting__A_1"].assign(joint_offsets=offsets)
    results = whole() | {"body_fitting__A_1": fits}
    every = replace(origin(match_folder, **results), definition="detector")
    joints, *_ = export(every, ["joints"], tmp_path / "out")
    assert np.isfinite(read_joints(joints).joints).any()
    with pytest.raises(InputError, match="expected a person with joints"):
        export(replace(every, definition="body"), ["joints"], tmp_path / "bodies")


def test_an_export_is_repeated_into_its_folder_and_joined_by_others(match_folder, tmp_path):
    run, out = origin(match_folder, **tracked()), tmp_path / "out"
    first = export(run, ["joints"], out)
    (out / "mine.txt").write_text("kept")
    (out / "frame_rates.json").write_text('{"other": 25.0}')
    assert export(run, ["joints", "csv"], out)[:1] == first[:1]
    assert (out / "mine.txt").read_text() == "kept"
    assert json.loads((out / "frame_rates.json").read_text()) == {"other": 25.0, "A_1": 50.0}
    # A later format that fails leaves the earlier ones as they are.
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    without = {name: data for name, data in tracked().items() if "broadcast" not in name}
    with pytest.raises(WorldposeError, match="broadcast_calibration/A_1"):
        export(origin(match_folder, **without), ["joints", "trc", "challenge"], out)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_an_export_replaces_no_file_of_another_match(match_folder, tmp_path):
    ours, out = origin(match_folder, **whole()), tmp_path / "out"
    for path in export(restated(ours, match_id="another"), ["positions", "joints"], out):
        if path.name != "frame_rates.json":
            path.write_bytes(b"other content")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"A_1\.csv.*a file of another.*--overwrite"):
        export(ours, ["csv", "positions"], out)
    (tmp_path / "view.html").write_text("a page of unknown origin")
    with pytest.raises(InputError, match="Nothing was written"):
        export(ours, ["viewer"], tmp_path / "view.html")
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    export(ours, ["csv"], out)  # files of other names are no obstacle
    export(ours, ["positions"], out, overwrite=True)
    export(ours, ["positions"], out)
    with pytest.raises(InputError, match=r"joints\.npz.*a file of another"):
        export(ours, ["joints"], out)


def test_a_disk_that_refuses_is_named_and_nothing_is_left(match_folder, tmp_path, monkeypatch):
    run, code = origin(match_folder, **tracked()), errno.ENOSPC

    def fail(origin, out):
        (out / "half.txt").write_text("half")
        raise OSError(code, os.strerror(code), str(out / "half.txt"))

    monkeypatch.setitem(export_module.EXPORTS, "csv", fail)
    with pytest.raises(InputError, match=f"found {os.strerror(code)}.*nothing was written") as told:
        export(run, ["joints", "csv"], tmp_path / "new" / "out")
    assert str(tmp_path / "new" / "out") in told.value.where
    assert not (tmp_path / "new").exists()


def test_a_target_of_another_kind_is_refused(match_folder, tmp_path):
    run = origin(match_folder, **tracked())
    (tmp_path / "file").write_text("mine")
    (tmp_path / "page.html").mkdir()
    (tmp_path / "out" / "joints.npz").mkdir(parents=True)
    for out, form, found in (
        (tmp_path / "file", "joints", "found a file"),
        (tmp_path / "page.html", "viewer", "found a folder"),
        (tmp_path / "out", "joints", "joints.npz: .* found a folder"),
    ):
        with pytest.raises(InputError, match=found) as refused:
            export(run, [form], out)
        assert "--out" in refused.value.where and "nothing was written" in refused.value.todo
    assert (tmp_path / "file").read_text() == "mine"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["joints.npz"]


@pytest.mark.parametrize(("form", "package"), [("usd", "pxr"), ("rerun", "rerun")])
def test_a_missing_package_is_named(match_folder, tmp_path, monkeypatch, form, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UsageError, match=rf"worldpose\[{form}\]"):
        export(origin(match_folder, **whole()), [form], tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("nobody", "--format", "joints"), 1, "match nobody: expected a match folder or one of"),
        (("MATCH", "--format", "excel"), 2, "^error: --format excel: expected one of joints"),
        (("nobody", "--format", "excel"), 2, "^error: --format excel: expected one of joints"),
        (("MATCH", "--format", "joints", "--stage", "sleep"), 2, "--stage sleep: expected a resu"),
        (("MATCH", "--format", "challenge", "--format", "worldpose"), 2, "different file names"),
        (("MATCH", "--format", "gltf", "--licence", "EMPTY"), 1, "--licence .*found nothing"),
        (("MATCH", "--format", "joints", "--release", "one"), 2, "expected --licence FILE"),
    ],
)
def test_the_command_says_one_thing_and_writes_nothing(
    tiny_run, tmp_path, monkeypatch, arguments, code, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.txt").write_bytes(b"")
    words = {"MATCH": TINY, "EMPTY": "empty.txt"}
    asked = [words.get(each, each) for each in arguments]
    answer = worldpose("export", *asked, "--out", "out", "--project", tiny_run)
    assert answer.code == code, answer.err
    assert re.search(message, answer.err)
    assert answer.err.count("error:") == 1 and "Traceback" not in answer.err
    assert {path.name for path in tmp_path.iterdir()} == {"empty.txt"}


def test_a_stage_of_joints_is_refused_for_other_formats(match_folder, tmp_path):
    run = replace(origin(match_folder, **whole()), stage="triangulation")
    with pytest.raises(UsageError, match=r"--stage triangulation: .* found --format gltf, of"):
        export(run, ["joints", "gltf"], tmp_path / "out")


@pytest.mark.parametrize("left", ["triangulation", "broadcast_tracking"])
def test_people_without_bodies_are_no_cameras_alone(match_folder, tmp_path, left):
    kept = ("tracking__A_1", "broadcast_calibration__A_1")
    results = {name: data for name, data in whole().items() if name in kept}
    results[f"{left}__A_1"] = whole()["triangulation__A_1"]
    with pytest.raises(InputError, match="results of body_fitting/A_1"):
        export(origin(match_folder, **results), ["worldpose"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_lens_that_cannot_be_followed_is_refused_before_the_first_file(
    match_folder, tmp_path, monkeypatch
):
    cameras = {  # half of the image is beyond 70 degrees
        "north": replace(
            look_at_camera([0, -20, 5], [0, 0, 0], 400.0), lens_model=LensModel.FISHEYE
        )
    }
    monkeypatch.setattr(Origin, "static_cameras", cameras)
    with pytest.raises(InputError, match=r"worldpose: north: .*in half of the image"):
        list(EXPORTS["worldpose"](origin(match_folder, **whole()), tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_every_format_has_a_writer_and_is_named_in_the_help_and_the_reference():
    help_text = invoke("export", "--help", env={"COLUMNS": "200"}).output
    help_text = re.sub(r"-\n\s+", "-", help_text)  # a line may end at a hyphen
    page = (Path(__file__).parents[2] / "docs/reference/formats.md").read_text()
    assert tuple(EXPORTS) == EXPORT_FORMATS
    assert set(EXPORT_FORMATS) >= CLASHING | COUNTED
    for name, purpose in EXPORT_PURPOSES.items():
        assert f"{name:15} {purpose}\n" in help_text, name
        assert f"- `{name}`: {purpose}" in page
    for name in EXPORT_FORMATS:
        assert re.search(rf"\b{name}\b(?!-)", help_text), name
        assert f"| `{name}` |" in page


@pytest.mark.parametrize("asked", ["south", "main", "nobody"])
def test_a_camera_without_a_video_of_its_own_is_refused_before_anything_is_written(tmp_path, asked):
    names = {"north": "static", "south": "static", "main": "broadcast"}
    cameras = {name: {"kind": kind} for name, kind in names.items()}
    spec = match_spec(cameras, {"clip": {"frame_count": 4, "broadcast": "main"}})
    folder = SimpleNamespace(spec=spec, videos={"north": "a.mp4", "clip": "b.mp4"})
    page = tmp_path / "report.html"
    with pytest.raises(UsageError, match=rf"--camera {asked}: .*these have one: north\."):
        there = SimpleNamespace(folder=folder)
        write_report(None, SimpleNamespace(at_hand=lambda: there), page, camera=asked)
    assert not page.exists()
