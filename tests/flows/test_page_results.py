"""The page of a match shows and downloads the results of a complete run."""

import io
import json
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import TINY
from page_client import MATCH

from data_contracts.release import EXPORT_FORMATS
from flows.reports import scene_data
from flows.results.best_results import body_tracks
from worldpose.store import open_run

SCRIPT = Path(__file__).with_name("scene_data.mjs")
PAGES = Path(__file__).parents[2] / "infra" / "review_pages"


def test_a_complete_run_gives_its_report_and_its_exports(ada):
    found = ada.get(f"{MATCH}/results").json()
    assert (found["run"], found["formats"]) == ("0001", list(EXPORT_FORMATS))
    assert found["clips"] == [{"id": "clip", "video": None}]  # given keypoints: nothing is filmed
    page = ada.get(f"{MATCH}/results/report")
    assert page.headers["content-type"].startswith("text/html")
    assert "3D view" in page.text
    # Its scripts run without a session: they can neither read nor change anything here.
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in policy
    assert "default-src 'none'" in policy
    answer = ada.get(f"{MATCH}/results/exports/joints")
    assert "0001-joints.zip" in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        joints = np.load(io.BytesIO(archive.read("joints.npz")))["joints"]
    assert joints.shape[2:] == (17, 3)
    assert np.isfinite(joints).any()
    # Asked again, it is the file that was drawn.
    assert ada.get(f"{MATCH}/results/exports/joints").content == answer.content


@pytest.mark.parametrize("path", ["videos/clip", "videos/other", "exports/fbx"])
def test_what_there_is_none_of_is_said(ada, path):
    assert ada.get(f"{MATCH}/results/{path}").status_code == 404


def test_an_export_that_lacks_a_result_says_what_to_do(ada):
    answer = ada.get(f"{MATCH}/results/exports/slahmr-cameras")
    assert answer.status_code == 422
    assert "expected" in answer.json()["error"]


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_the_3d_view_poses_people_as_the_body_model_does(ada, project_copy, tmp_path):
    scene = ada.get(f"{MATCH}/results/scenes/clip").content
    frames = ada.get(f"{MATCH}/results/scenes/clip/frames?first=0&count=10000").content
    (tmp_path / "scene").write_bytes(scene)
    (tmp_path / "frames").write_bytes(frames)
    module = PAGES / "src" / "scene3d.js"
    command = ["node", SCRIPT, module, tmp_path / "scene", tmp_path / "frames"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    seen = json.loads(done.stdout)
    run = open_run(str(project_copy), TINY, complete=True)
    bodies = body_tracks(run, "clip")
    joints, surfaces = bodies.model.joints(bodies.poses), bodies.model.vertices(bodies.poses)
    shown = range(0, len(bodies.frames), seen["every"])
    assert [len(person) for person in seen["people"]] == [len(shown)] * len(bodies.person_ids)
    count = 0
    for column, person in enumerate(seen["people"]):
        for frame, posed in zip(shown, person, strict=True):
            if posed is None:
                assert np.isnan(joints[frame, column]).any()
                continue
            np.testing.assert_allclose(posed["joints"], joints[frame, column], atol=2e-3)
            # Four joints move a vertex of the view, and its shape does not follow the pose.
            far = np.linalg.norm(posed["placed"] - surfaces[frame, column, ::500], axis=-1)
            assert far.max() < 0.06
            count += 1
    assert count > 10


def test_thirty_seconds_of_a_full_pitch_are_small(ada):
    scene = ada.get(f"{MATCH}/results/scenes/clip").content
    frames = ada.get(f"{MATCH}/results/scenes/clip/frames?first=0&count=10000").content
    header = json.loads(scene[4 : 4 + int.from_bytes(scene[:4], "little")])
    people = len(header["people"])
    assert header["range_frames"] == 750
    each = len(frames) / header["frames"] / people
    assert 22 * 750 * each + len(scene) / people * 22 < 15e6
    part = ada.get(f"{MATCH}/results/scenes/clip/frames?first=3&count=2").content
    assert json.loads(part[4 : 4 + int.from_bytes(part[:4], "little")])["count"] == 2
    assert ada.get(f"{MATCH}/results/scenes/other").status_code == 404
    assert ada.get(f"{MATCH}/results/scenes/clip/frames?first=-1&count=2").status_code == 422


def test_the_surface_of_a_licensed_body_stays_on_the_machine(project_copy):
    bodies = body_tracks(open_run(str(project_copy), TINY, complete=True), "clip")
    licensed = replace(bodies, model=replace(bodies.model, name="smpl-neutral/1"))
    assert {"surface", "faces"} <= set(scene_data._body_arrays(bodies))
    assert set(scene_data._body_arrays(licensed)) == {"rest_joints", "parents"}
