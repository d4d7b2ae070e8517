"""Releases and their check on the command line."""

import json
import shutil

import numpy as np
import pytest
from command_line import TINY, succeed, worldpose

from worldpose.errors import InputError
from worldpose.formats.joints_file import read_joints
from worldpose.store.garbage import plan_gc
from worldpose.store.runs import list_pins
from worldpose.store.store import Store

pytestmark = pytest.mark.usefixtures("server")


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
    assert report["passed"]
    assert report["clips"]["clip"]["compared"] > 1000
    # COCO has hundredths of a pixel.
    assert report["clips"]["clip"]["reprojection_median_px"] < 0.02
    spoilt = shutil.copytree(released, tmp_path / "spoilt")
    for path in (spoilt / "cameras").glob("cam*.npz"):
        with np.load(path) as file:
            arrays = dict(file)
        arrays["R"] = arrays["R"].swapaxes(-1, -2)
        np.savez(path, **arrays)
    answer = worldpose("check", spoilt, "--json")
    assert answer.code == 1
    faults = {finding["fault"] for finding in answer.json["findings"]}
    assert faults == {"changed_files", "transposed_rotation"}
    assert "transposed_rotation: R is world_from_cam" in worldpose("check", spoilt).out


def test_the_run_of_a_release_is_never_collected(released, project):
    store = Store.open(project)
    manifest = json.loads((released / "manifest.json").read_text())
    match, run = manifest["match_id"], manifest["run_id"]
    assert [(pin.name, pin.run_id) for pin in list_pins(store.blobs, match)] == [
        ("release-first", run)
    ]
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
