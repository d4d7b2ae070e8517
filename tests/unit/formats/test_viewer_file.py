"""A viewer file holds what the store has, and its script poses people as the body model does."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from viewer_clips import CENTER, bodies_clip, mixed_clip

from worldpose.errors import InputError
from worldpose.formats import viewer_file
from worldpose.formats.viewer_file import (
    decode_bodies,
    decode_part,
    encode_frames,
    encode_scene,
    read_viewer,
    write_viewer,
)

ROOT = Path(__file__).parents[3]
SCRIPT = Path(__file__).with_name("viewer_in_node.mjs")
MODULE = ROOT / "infra" / "review_pages" / "src" / "viewer" / "payload.js"
PAGE = "<title>worldpose viewer</title><body><!--worldpose-data--><script>1</script></body>"
IN_NODE = pytest.mark.skipif(shutil.which("node") is None, reason="no node")
MAX_JOINT_M, MAX_ROTATION_DEG = 1e-4, 0.01


def pose_in_node(clip, folder):
    """What the script of the page makes of all parts of a clip."""
    parts = [folder / "scene"]
    parts[0].write_bytes(encode_scene(clip))
    for first in range(0, len(clip.frames), clip.range_frames):
        parts.append(folder / f"range-{first}")
        parts[-1].write_bytes(encode_frames(clip, first, clip.range_frames))
    command = ["node", SCRIPT, MODULE, *parts]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def rotation_errors_deg(found, truth):
    found, truth = (np.reshape(each, (-1, 3, 3)) for each in (found, truth))
    return np.degrees((Rotation.from_matrix(found) * Rotation.from_matrix(truth).inv()).magnitude())


def test_joints_and_rotations_come_back_from_the_parts():
    clip = bodies_clip(frames=600, people=3)
    scene = encode_scene(clip)
    truth = clip.model.articulate(clip.bodies).rotations
    joints = clip.model.joints(clip.bodies)
    assert clip.range_frames == 500
    for first in (0, 500):
        turned, placed = decode_bodies(scene, encode_frames(clip, first, 500))
        here = slice(first, first + 500)
        there = np.isfinite(joints[here])
        assert np.array_equal(np.isfinite(placed), there)
        far = np.linalg.norm(placed - joints[here], axis=-1)
        assert np.nanmax(far) < MAX_JOINT_M
        known = there.all(axis=(-1, -2))
        assert known.sum() >= 300
        assert rotation_errors_deg(turned[known], truth[here][known]).max() < MAX_ROTATION_DEG


@IN_NODE
def test_the_page_poses_bodies_as_the_model_does(tmp_path):
    clip = bodies_clip(frames=40)
    seen = pose_in_node(clip, tmp_path)["frames"]
    joints, surfaces = clip.model.joints(clip.bodies), clip.model.vertices(clip.bodies)
    rotations = clip.model.articulate(clip.bodies).rotations
    for frame, people in enumerate(seen):
        for column, posed in enumerate(people):
            if posed is None:
                assert np.isnan(joints[frame, column]).any()
                continue
            assert posed["kind"] == "body"
            far = np.linalg.norm(posed["joints"] - joints[frame, column], axis=-1)
            assert far.max() < MAX_JOINT_M
            wrong = rotation_errors_deg(posed["rotations"], rotations[frame, column])
            assert wrong.max() < MAX_ROTATION_DEG
            # Four joints move a vertex of the view, and its shape does not follow the pose.
            away = np.linalg.norm(posed["placed"] - surfaces[frame, column, ::500], axis=-1)
            assert away.max() < 0.08
    assert [frame for frame, people in enumerate(seen) if people[0] is None] == [5, 6, 7, 8]


@IN_NODE
def test_the_page_shows_joints_feet_and_evidence_of_people_without_a_body(tmp_path):
    clip = mixed_clip(frames=10)
    shown = pose_in_node(clip, tmp_path)
    people = shown["frames"][9]
    assert [person["kind"] for person in people] == ["body", "joints", "feet"]
    assert [person["kind"] for person in shown["people"]] == ["triangulated"] * 2 + ["plane"]
    assert people[1]["joints"][3] is None
    known = [0, 1, 2, *range(4, 17)]
    found = np.array([people[1]["joints"][joint] for joint in known])
    assert np.linalg.norm(found - clip.joints[9, 1, known], axis=-1).max() < MAX_JOINT_M
    np.testing.assert_allclose(people[2]["feet"], [1.0, -6.0])
    assert people[2]["feetSpread"] == 0.25
    assert shown["frames"][2][2] is None
    # A step of the logarithmic scale of uncertainty is 2.8 %.
    np.testing.assert_allclose(people[0]["spread"], clip.spread[9, 0], rtol=0.014)
    assert people[0]["views"] == clip.views[9, 0].tolist()


def test_cameras_and_the_pitch_are_those_of_the_clip():
    clip = bodies_clip(frames=3)
    header, _ = decode_part(encode_scene(clip))
    row = np.array(header["cameras"][0]["row"])
    rotation = row[:9].reshape(3, 3)
    np.testing.assert_allclose(-rotation.T @ row[9:12], CENTER, atol=1e-5)
    np.testing.assert_allclose(row[12:], [2000.0, 2000.0, 959.5, 539.5, 1920, 1080])
    # The point in the middle of a straight line says nothing.
    assert header["markings"] == [[[-52.5, -34.0, 0.0], [52.5, -34.0, 0.0], [52.5, 34.0, 0.0]]]
    _, arrays = decode_part(encode_frames(clip, 0, 3))
    np.testing.assert_allclose(arrays["moving"][:, 0], np.tile(row, (3, 1)), atol=1e-4)


def test_the_surface_of_a_licensed_body_stays_on_the_machine():
    clip = bodies_clip(frames=2)
    licensed = replace(clip, model=replace(clip.model, name="smpl-neutral/1"))
    assert {"surface", "faces"} <= set(decode_part(encode_scene(clip))[1])
    assert set(decode_part(encode_scene(licensed))[1]) == {"rest_joints", "parents"}


def test_a_file_holds_several_clips_and_videos_and_its_notes(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"\0film")
    clips = [bodies_clip(frames=3), replace(mixed_clip(frames=3), clip="other")]
    write_viewer(tmp_path / "v.html", PAGE, clips, {"other": tmp_path / "film.mp4"})
    first, second = read_viewer(tmp_path / "v.html")
    assert "video" not in first
    assert second["video"] == b"\0film"
    assert decode_part(second["scene"])[0]["notes"]["licence"] == "For tests alone."
    text = (tmp_path / "v.html").read_text()
    assert "<title>m &amp; n: half, other</title>" in text
    assert text.index("data-clip") < text.index("<script>1")


def test_a_file_that_browsers_refuse_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer_file, "MAX_FILE_BYTES", 100_000)
    with pytest.raises(InputError, match=r"expected at most 0\.1 MB"):
        write_viewer(tmp_path / "v.html", PAGE, [bodies_clip(frames=300)], {})
    assert list(tmp_path.iterdir()) == []
