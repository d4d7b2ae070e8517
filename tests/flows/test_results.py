"""Outputs of a run: metrics against ground truth, exports, a page, labelled arrays; releases."""

import base64
import json
import re
import shutil
from html import escape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import TINY, succeed, worldpose

from data_contracts.conventions import COCO17, JOINT_GROUPS
from flows.layers import write_layer
from flows.registering import open_match
from flows.reports import report, viewer
from flows.reports.people import body_tables
from flows.results.automatic_exports import export_after_run
from flows.results.best_results import LIMB_ENDS
from worldpose import open_run
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.errors import InputError
from worldpose.formats.joints_file import read_joints, read_poses
from worldpose.formats.release_cameras import read_camera
from worldpose.store.garbage import plan_gc
from worldpose.store.runs import list_pins
from worldpose.store.store import Store

pytestmark = pytest.mark.usefixtures("server")


def test_figures_against_truth(tiny, tiny_run):
    figures = succeed(
        *("evaluate", "--prediction", tiny, "--reference", tiny / "reference"),
        *("--project", tiny_run, "--json"),
    ).json
    # Noise of a few pixels at 115 px per person, averaged over six views: seen 29 mm.
    assert 5 < figures["mpjpe_mm"] < 60
    assert figures["pcp3d"] > 97
    assert (figures["coverage"], figures["persons"]) == (1, 5)


def test_a_report_compares_bodies_with_joints_in_held_out_cameras(tiny_run):
    run = open_run(tiny_run, TINY)
    figures = run.record.figures["body_fitting/clip"]
    (table,) = (each for each in body_tables(run, ("clip",)) if "held out" in each.heading)
    assert [row[0] for row in table.rows] == list(JOINT_GROUPS)
    for row in table.rows:
        shown = figures[f"held_out_fitted_m.{row[0]}"], figures[f"held_out_triangulated_m.{row[0]}"]
        assert row[1:3] == tuple(f"{1e3 * value:.1f}" for value in shown)
        certain = figures[f"held_out_certain_excess_m.{row[0]}"]
        assert (row[-1] != "") == (certain > 0.0)


def test_joints_of_bodies_are_exported_where_the_detector_sees_them(tiny_run, tmp_path):
    succeed(*("export", TINY, "--format", "joints", "--out", tmp_path, "--project", tiny_run))
    tracks = read_joints(tmp_path / "joints.npz")
    result = open_run(tiny_run, TINY)["body_fitting/clip"]
    np.testing.assert_array_equal(tracks.frames, np.arange(30))
    ends = np.isin(np.arange(17), LIMB_ENDS)
    offsets = np.where(ends[:, None], 0.0, result["joint_offsets"].values)
    from_body = np.where(tracks.source >= 2, 1.0, np.nan)[..., None]
    moved = np.linalg.norm(from_body * (tracks.joints - result["joints"].values), axis=-1)
    assert np.abs(offsets).max() > 1e-3
    expected = np.linalg.norm(offsets, axis=-1)
    np.testing.assert_allclose(np.nanmax(moved, axis=(0, 1)), expected, rtol=1e-6, atol=1e-12)
    # The error that all views share is one about a constant offset: it stays.
    same = from_body[..., None] * np.stack([tracks.covariance, result["covariance"].values])
    np.testing.assert_array_equal(*same)


def test_exported_coco_lies_on_the_detections(tiny, tiny_run, tmp_path):
    succeed(*("export", TINY, "--format", "coco", "--out", tmp_path, "--project", tiny_run))
    spec = yaml.safe_load((tiny / "match.yaml").read_text())
    cameras = [camera["id"] for camera in spec["cameras"] if camera["kind"] == "static"]
    assert sorted(path.stem for path in tmp_path.glob("*.json")) == cameras
    dataset = json.loads((tmp_path / f"{cameras[0]}.json").read_text())
    assert len(dataset["images"]) == 30
    with np.load(tiny / "detections" / f"{cameras[0]}.npz") as detections:
        keypoints = detections["keypoints"]
    distances = []
    for annotation in dataset["annotations"]:
        points = np.array(annotation["keypoints"]).reshape(17, 3)
        seen = points[:, 2] == 2
        if seen.any():
            offsets = keypoints[annotation["image_id"]][:, seen] - points[seen, :2]
            # All joints that this camera agreed with come from one of its detections.
            whole = np.isfinite(offsets).all(axis=(1, 2))
            assert whole.any(), "a joint is called observed that no detection has"
            distances.append(np.linalg.norm(offsets[whole], axis=-1).mean(axis=-1).min())
    # Joints that this camera agreed with are a few pixels from what it detected.
    assert np.median(distances) < 5


def test_the_example_in_the_docs_gives_labelled_joints_with_units(tiny_run, tmp_path, capsys):
    page = (Path(__file__).parents[2] / "docs/how-to/library.md").read_text()
    examples = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (example,) = (each for each in examples if "worldpose-data" in each)
    assert len([line for line in example.splitlines() if line.strip()]) <= 5
    exec(example.replace("worldpose-data", str(tiny_run)).replace('"lab"', f'"{TINY}"'), {})
    assert capsys.readouterr().out == "('frame', 'joint', 'coordinate') m\n"


def test_the_notebook_in_the_docs_runs(tiny_run, capsys):
    page = (Path(__file__).parents[2] / "docs/how-to/notebook.md").read_text()
    cells = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    found = {}
    exec(cells.replace("worldpose-data", str(tiny_run)).replace('"lab"', f'"{TINY}"'), found)
    assert float(found["part"].time[0]) >= 0.2 and float(found["part"].time[-1]) <= 0.8
    assert found["knee"].attrs["units"] == "rad"
    nose = found["bodies"].joints.values[0, 0, 0]
    np.testing.assert_array_equal(found["table"].loc[(0, 0, "nose"), ["x", "y", "z"]], nose)
    assert "nose" in capsys.readouterr().out


class Outside(HTMLParser):
    """Collects the links and sources of a page that point to other files."""

    def __init__(self):
        super().__init__()
        self.asked = []

    def handle_starttag(self, tag, attributes):
        self.asked += [
            value
            for name, value in attributes
            if name in ("src", "href") and not value.startswith(("data:", "#"))
        ]


def test_the_release_layout_holds_bodies_whose_keypoints_are_the_run_s_joints(tiny_run, tmp_path):
    succeed(*("export", TINY, "--format", "worldpose", "--out", tmp_path, "--project", tiny_run))
    run = open_run(tiny_run, TINY)
    poses, body_model = read_poses(tmp_path / "poses" / "clip.npz")
    assert body_model == run["body_fitting/clip"].attrs["body_model"]
    keypoints = fold_keypoints(load_open_body(), COCO17)(poses).swapaxes(0, 1)
    # Single precision: micrometres at the pitch's corners, and angles add a few along a limb.
    np.testing.assert_allclose(keypoints, run["body_fitting/clip"].joints.values, atol=5e-5)
    adjusted = run["bundle_adjustment/cameras"]
    for index, name in enumerate(adjusted.camera.values):
        camera = read_camera(tmp_path / "cameras" / f"{name}.npz")
        np.testing.assert_array_equal(camera.focal, adjusted.focal.values[index])
        np.testing.assert_array_equal(
            camera.cam_from_world.translation, adjusted.translation.values[index]
        )


def test_the_view_of_a_report_is_cut_where_it_would_be_too_large(tiny_run, monkeypatch):
    run = open_run(tiny_run, TINY)
    match = open_match(Store.open(str(tiny_run)), TINY)
    (whole,), said = viewer.report_viewer(run, match)
    assert said == ""
    monkeypatch.setattr(viewer, "REPORT_POSES", 5 * 11 + 4)  # of five people
    (page,), said = viewer.report_viewer(run, match)
    assert "first 0.4 s of 1.2 s" in said
    for shown, frames in ((whole, 30), (page, 11)):
        data = re.search(r'data-part="scene">([^<]*)</script>', shown.html)[1]
        header = base64.b64decode(data).decode("latin-1")
        assert int(re.search(r'"frames":(\d+)', header)[1]) == frames
    monkeypatch.setattr(viewer, "REPORT_POSES", 4)
    assert viewer.report_viewer(run, match) == ((), "")


def test_report_is_one_page_that_asks_for_nothing(tiny, tiny_run, tmp_path):
    out, figures = tmp_path / "report.html", tmp_path / "figures"
    succeed("report", tiny, "--out", out, "--project", tiny_run, "--figures", figures)
    page = out.read_text()
    outside = Outside()
    outside.feed(page)
    assert (outside.asked, page.count('src="data:image/')) == ([], 11)
    assert page.count("<iframe") == 1
    for said in ("Mean joint error", "expected ground error", "triangulation/clip"):
        assert said in page
    people = re.search(r"<h2[^>]*>People</h2>.*?</table>", page, re.DOTALL)[0]
    assert people.count("triangulated</td>") == 5 and "top speed m/s" in people
    for suffix in (".svg", ".pdf", ".json"):
        assert len(list(figures.glob(f"*{suffix}"))) == 11
    for number, file in enumerate(sorted(figures.glob("*.json")), start=1):
        shown = json.loads(file.read_text())
        assert file.name.startswith(f"{number:02d}-")
        assert escape(shown["caption"], quote=False).partition("'")[0] in page
        assert any(panel["series"] for panel in shown["panels"])
    # Neither a page nor figures of another origin are replaced.
    other, plot = tmp_path / "other.html", tmp_path / "others" / "01-plot.svg"
    plot.parent.mkdir()
    asked = {other: ("--out", other), plot: ("--out", out, "--figures", plot.parent)}
    for file, options in asked.items():
        file.write_text("other")
        answer = worldpose("report", tiny, "--project", tiny_run, "--no-videos", *options)
        assert answer.code == 1 and "a file of unknown origin" in answer.err
        assert (file.read_text(), out.read_text()) == ("other", page)


@pytest.mark.slow
def test_a_reference_that_is_not_scored_is_said(tiny, store, tmp_path, monkeypatch):
    page, own = tmp_path / "report.html", shutil.copytree(tiny, tmp_path / "match") / "reference"
    (own / "joints.npz").write_bytes(b"PK")
    there = {"folder": str(own.parent)}
    store.register(store.registration(TINY).model_copy(update=there))
    given = ("report", TINY, "--project", store.url, "--no-videos", "--out", page)
    answer = worldpose(*given)  # nobody asked for it
    assert (answer.code, "warning: The results are not scored" in answer.err) == (0, True)
    assert "Against the truth" in page.read_text()
    assert worldpose(*given, "--reference", own).code == 1
    match, run = open_match(store, TINY), open_run(store.url, TINY)
    for clips, told in ((("first", "second"), "the run has 2 clips"), ((), "the run has 0 clips")):
        monkeypatch.setattr(report, "find_clips", lambda record, clips=clips: clips)
        *_, said = report._against_truth(store, run, match, str(tiny / "reference"))
        assert told in said and ("clip by clip" in said) == bool(clips)
    shutil.copy(tiny / "reference" / "joints.npz", own)
    assert report._against_truth(store, run, match, None)[2] == ""  # nobody asked for it


def test_a_run_without_people_exports_its_cameras_alone(store):
    write_layer(store, "project", {"exports": ["joints", "worldpose", "slahmr-cameras"]})
    record = store.run(TINY)
    calibrated = {n: key for n, key in record.results.items() if n.startswith("static_cal")}
    cameras = [f"{name.partition('/')[2]}.npz" for name in sorted(calibrated)]
    for results, names in (({}, []), (calibrated, cameras)):
        without = record.model_copy(update={"results": results})
        files = export_after_run(store, open_match(store, TINY), without)
        assert [file.name for file in files if file.suffix == ".npz"] == names


@pytest.fixture(scope="module")
def project(tiny_run, tmp_path_factory):
    """A copy of the project, since a release pins its run."""
    return shutil.copytree(tiny_run, tmp_path_factory.mktemp("pinned") / "project")


@pytest.fixture(scope="module")
def exporting(project, tmp_path_factory):
    """Arguments of an export of the tiny match as a release."""
    licence = tmp_path_factory.mktemp("licence") / "LICENCE.txt"
    licence.write_text("For tests alone.\n")
    forms = [word for form in ("worldpose", "coco", "joints") for word in ("--format", form)]
    release = ("--release", "first", "--licence", licence, "--project", project)
    return ("export", TINY, *forms, *release)


@pytest.fixture(scope="module")
def released(exporting, tmp_path_factory):
    """A folder with a release; read only."""
    out = tmp_path_factory.mktemp("release") / "first"
    succeed(*exporting, "--out", out)
    return out


def test_a_release_names_its_run_files_and_licence(released):
    manifest = json.loads((released / "manifest.json").read_text())
    assert manifest["release"] == "first"
    assert manifest["licence"] == "For tests alone."
    assert manifest["definition"] == "body"
    tracks = read_joints(released / "joints.npz")
    assert {3} <= set(np.unique(tracks.source)) <= {0, 3}
    assert manifest["usability"]["verdict"] == "usable with reservations"
    assert manifest["body_model"] == "open-neutral/2"
    assert "body_fitting/clip" in manifest["results"]
    on_disk = {path.relative_to(released).as_posix() for path in released.rglob("*.*")}
    assert {file["path"] for file in manifest["files"]} == on_disk - {"manifest.json"}
    origins = np.load(released / "origins" / "clip.npz")["origin"]
    assert origins.shape == (30, 5, 17)
    assert sum(manifest["clips"]["clip"]["origins"].values()) == origins.size


def test_a_release_passes_its_check_and_a_changed_one_fails_by_name(released, tmp_path):
    report = succeed("check", released, "--json").json
    assert report["passed"] and report["clips"]["clip"]["compared"] > 1000
    # COCO has hundredths of a pixel.
    assert report["clips"]["clip"]["reprojection_median_px"] < 0.02
    spoilt = shutil.copytree(released, tmp_path / "spoilt")
    for path in (spoilt / "cameras").glob("cam*.npz"):
        arrays = dict(np.load(path))
        np.savez(path, **arrays | {"R": arrays["R"].swapaxes(-1, -2)})
    answer = worldpose("check", spoilt, "--json")
    faults = {finding["fault"] for finding in answer.json["findings"]}
    assert (answer.code, faults) == (1, {"changed_files", "transposed_rotation"})


def test_the_run_of_a_release_is_never_collected(released, project):
    store = Store.open(project)
    manifest = json.loads((released / "manifest.json").read_text())
    match, run = manifest["match_id"], manifest["run_id"]
    pins = [(pin.name, pin.run_id) for pin in list_pins(store.blobs, match)]
    assert pins == [("release-first", run)]
    with pytest.raises(InputError, match=r"pinned as release-first\. .*worldpose unpin"):
        plan_gc(store, forget=[f"{match}/{run}"])


def test_a_release_is_frozen(released, exporting):
    before = {path: path.read_bytes() for path in released.rglob("*.*")}
    succeed(*exporting, "--out", released)
    assert {path: path.read_bytes() for path in released.rglob("*.*")} == before
    renamed = [("second" if word == "first" else word) for word in exporting]
    answer = worldpose(*renamed, "--out", released)
    assert answer.code == 2
    assert "a release is never overwritten" in answer.err
    assert {path: path.read_bytes() for path in released.rglob("*.*")} == before
