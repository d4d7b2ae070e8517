"""Both sides of a score by data set: what is stated around a folder, who counts, short clips."""

import numpy as np
import pytest
import yaml
from camera_builders import look_at_camera

from data_contracts.conventions import COCO17
from flows.results.dataset import check, count, stated_rates
from flows.results.evaluation import score
from worldpose.body.body_file import OPEN_BODY
from worldpose.body.model import BodyParameters
from worldpose.dataset.benchmark import score_folders
from worldpose.dataset.contents import CameraView, PointSource
from worldpose.dataset.manifest import write_frame_rates
from worldpose.dataset.plausibility import turning_findings
from worldpose.errors import InputError
from worldpose.formats.joints_file import JointTracks, write_joints, write_poses
from worldpose.formats.release_cameras import CameraRows


def write_match(folder, kind):
    """Write match.yaml of 25 frames/s with one camera of a kind."""
    content = {
        "contract": 1,
        "match_id": "m",
        "fps": 25.0,
        "cameras": [{"id": "cam", "kind": kind, "width": 1920, "height": 1080}],
        "clips": [{"id": "clip", "first_frame": 0, "frame_count": 10}],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "match.yaml").write_text(yaml.safe_dump(content))


def standing(frames, persons=1):
    """People 8 m apart with joints 10 cm apart."""
    rng = np.random.default_rng(3)
    joints = rng.uniform(-0.5, 0.5, (1, persons, 17, 3)) + [0.0, 0.0, 1.0]
    joints = joints + 8.0 * np.arange(persons)[None, :, None, None] * [1.0, 0.0, 0.0]
    return np.repeat(joints, frames, axis=0)


def test_the_rate_is_that_of_the_match_around_unless_the_folder_states_its_own(tmp_path):
    tracks = JointTracks(np.arange(10), np.arange(1), standing(10))
    write_joints(tmp_path / "reference" / "joints.npz", tracks)
    assert stated_rates(tmp_path / "reference") == {"clip": None}
    write_match(tmp_path, "static")
    assert stated_rates(tmp_path / "reference") == {"clip": 25.0}
    assert count([tmp_path / "reference"]).clips["clip"].seconds == 0.4
    assert stated_rates(tmp_path / "reference", 5.0) == {"clip": 5.0}
    (tmp_path / "match.yaml").write_text("of: another program")
    with pytest.raises(InputError, match=r"state the rate: --fps, or .*frame_rates\.json"):
        stated_rates(tmp_path / "reference")
    write_frame_rates(tmp_path / "reference", {"clip": 50.0})
    assert stated_rates(tmp_path / "reference") == {"clip": 50.0}


def test_a_side_in_another_unit_or_infinite_is_refused(tmp_path):
    frames, people, joints = np.arange(10), np.arange(2), standing(10, 2) + [30.0, 10.0, 0.0]
    mine, true = tmp_path / "mine", tmp_path / "true"
    write_joints(true / "A.joints.npz", JointTracks(frames, people, joints))
    for unit, size in (("millimetres", 1e3), ("centimetres", 1e2)):
        write_joints(mine / "A.joints.npz", JointTracks(frames, people, size * joints))
        with pytest.raises(InputError, match=rf"mine/A\.joints\.npz.*metres, found {unit}"):
            score_folders(true, {"mine": mine})
    write_joints(mine / "A.joints.npz", JointTracks(frames, people, joints))
    (found,), _ = score_folders(true, {"mine": mine})
    assert found.notes[f"{true}/cameras"].startswith("absent")
    place = joints.mean(axis=2).swapaxes(0, 1).copy()
    place[0, 3] = np.inf
    poses = BodyParameters(np.zeros((2, 1, 10)), np.zeros((2, 10, 3)), np.zeros((2, 10, 69)), place)
    write_poses(mine / "poses" / "A.npz", poses, OPEN_BODY)
    with pytest.raises(InputError, match=r"poses/A\.npz: transl: expected finite numbers"):
        score_folders(true, {"mine": mine})


def test_people_whom_one_camera_saw_count_by_no_door_unless_the_match_has_none(tmp_path):
    """The second of two people is 0.5 m off: she counts only where `views` are not of cameras."""
    joints, views = standing(10, 2), np.full((10, 2, 17), 3)
    views[:, 1] = 1
    reference, found = tmp_path / "match" / "reference", tmp_path / "found"
    moved = joints + [[0.01, 0.0, 0.0]]
    moved[:, 1] += [0.5, 0.0, 0.0]
    frames, persons = np.arange(10), np.arange(2)
    write_joints(found / "joints.npz", JointTracks(frames, persons, moved))

    def told():
        """Persons and error [mm] by each of the ways to score."""
        by_folder = score_folders(reference, {"found": found})[0][0].clips["clip"]
        single = score(str(found), str(reference), "").evaluation
        shown = [(each.persons, each.mpjpe_mm) for each in (by_folder, single)]
        return np.array(shown)

    write_joints(reference / "joints.npz", JointTracks(frames, persons, joints, views=views))
    np.testing.assert_allclose(told(), [[1, 10.0]] * 2)
    write_match(found, "broadcast")  # a prediction's match says nothing of the reference's views
    np.testing.assert_allclose(told(), [[1, 10.0]] * 2)
    (found / "match.yaml").unlink()
    write_match(tmp_path / "match", "static")
    np.testing.assert_allclose(told(), [[1, 10.0]] * 2)
    write_match(tmp_path / "match", "broadcast")
    np.testing.assert_allclose(told(), [[2, 260.0]] * 2)
    # Those of a broadcast camera alone, without a match that says so.
    (tmp_path / "match" / "match.yaml").unlink()
    for one in (0, 1):
        shown = JointTracks(frames, persons, joints, views=np.minimum(views, one))
        write_joints(reference / "joints.npz", shown)
        np.testing.assert_allclose(told(), [[2, 260.0]] * 2)
    write_match(tmp_path / "match", "static")
    assert told()[:, 0].tolist() == [0, 0]


def test_a_clip_with_nobody_is_checked_counted_and_scored(tmp_path):
    nobody = BodyParameters(np.zeros((0, 1, 10)), *(np.zeros((0, 5, n)) for n in (3, 69, 3)))
    write_poses(tmp_path / "poses" / "a.npz", nobody, OPEN_BODY)
    write_joints(tmp_path / "b.joints.npz", JointTracks(np.arange(5), np.arange(0), standing(5, 0)))
    assert [(one.frames, one.persons) for one in check(tmp_path).clips.values()] == [(5, 0)] * 2
    assert count([tmp_path]).poses == 0
    (scores,), _ = score_folders(tmp_path, {"same": tmp_path})
    assert (scores.evaluation.persons, scores.evaluation.g_mpjpe_mm) == (0, None)


@pytest.mark.parametrize("frames", [2, 3, 8])
def test_slips_of_challenge_clips_are_found_if_they_have_the_frames(frames):
    """Two people who part at 5 m/s, 2D of the frame before; the layout has one pose."""
    x = 0.2 * np.arange(frames + 1)[:, None, None, None]
    joints = standing(frames + 1, 2) + x * np.array([[-1.0], [1.0]])[:, None] * [1.0, 0.0, 0.0]
    camera = look_at_camera((2.0, -30.0, 8.0), (4.0, 0.0, 1.0), 2000.0)
    shown = camera.project(joints.reshape(frames + 1, -1, 3)).reshape(frames + 1, 2, 17, 2)
    one = (
        np.array([camera.cam_from_world.rotation]),
        np.array([camera.cam_from_world.translation]),
    )
    poses = [np.concatenate([each, np.full((frames - 1, *each.shape[1:]), np.nan)]) for each in one]
    lens = np.diag([2000.0, 2000.0, 1.0])
    lens[:2, 2] = camera.principal_point
    rows = CameraRows(np.tile(lens, (frames, 1, 1)), np.zeros((frames, 5)), *poses)
    slips = []
    for late in (0, 1):
        view = CameraView("a", rows, shown[:frames], COCO17)
        slips += turning_findings(PointSource("a", COCO17, joints[late : frames + late]), view)
    assert [each.fault for each in slips] == ["frame_offset"]


@pytest.mark.parametrize("frames", [1, 2, 3, 8])
def test_short_clips_are_scored_and_late_ones_are_told(tmp_path, frames):
    """People who move 0.2 m per frame and axis, each her own way."""
    ways = np.random.default_rng(4).normal(0.0, 0.2, (frames + 1, 2, 1, 3)).cumsum(axis=0)
    joints, persons = standing(frames + 1, 2) + ways, np.arange(2)
    for name, first in (("true", 1), ("same", 1), ("late", 0)):
        some = joints[first : first + frames]
        write_joints(
            tmp_path / name / "a.joints.npz", JointTracks(np.arange(frames), persons, some)
        )
    folders = {name: tmp_path / name for name in ("same", "late")}
    (same, late), _ = score_folders(tmp_path / "true", folders)
    assert same.evaluation.g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)
    assert list(same.notes) == [f"{tmp_path}/true/cameras"]
    assert any("1 frames late" in note for note in late.notes.values()) == (frames > 1)


def test_a_short_clip_whose_last_frame_is_off_is_not_early_or_late(tmp_path):
    true = standing(3) + 0.2 * np.arange(3)[:, None, None, None] * [1.0, 0.0, 0.0]
    found = true.copy()
    found[2] += [0.0, 0.8, 0.0]
    for name, some in (("true", true), ("found", found)):
        tracks = JointTracks(np.arange(3), np.arange(1), some)
        write_joints(tmp_path / name / "a.joints.npz", tracks)
    (scores,), _ = score_folders(tmp_path / "true", {"found": tmp_path / "found"})
    assert list(scores.notes) == [f"{tmp_path}/true/cameras"]


def test_frames_between_the_labelled_ones_are_refused_by_folder(tmp_path):
    for name, frames in (("true", [0, 10, 20]), ("found", [1, 4, 7, 11])):
        tracks = JointTracks(np.array(frames), np.arange(1), standing(len(frames)))
        write_joints(tmp_path / name / "a.joints.npz", tracks)
    with pytest.raises(InputError, match=r"none in common.*or predict the labelled frames, with"):
        score_folders(tmp_path / "true", {"found": tmp_path / "found"})


def test_views_of_the_joints_count_for_the_poses_beside_them(tmp_path):
    still = (np.zeros((2, 5, 3)), np.zeros((2, 5, 69)))
    transl = np.tile([[[0.0, 0.0, 1.0]], [[5.0, 0.0, 1.0]]], (1, 5, 1))
    for name, off in (("true", 0.0), ("found", 0.5)):
        places = transl + off * np.array([0.0, 1.0])[:, None, None] * [1.0, 0.0, 0.0]
        people = BodyParameters(np.zeros((2, 1, 10)), *still, places)
        write_poses(tmp_path / name / "poses" / "a.npz", people, OPEN_BODY)
    views = np.full((5, 2, 17), 3)
    views[:, 1] = 1
    tracks = JointTracks(np.arange(5), np.arange(2), standing(5, 2), views=views)
    write_joints(tmp_path / "true" / "a.joints.npz", tracks)
    (scores,), _ = score_folders(tmp_path / "true", {"found": tmp_path / "found"})
    assert scores.clips["a"].persons == 1
    assert scores.clips["a"].mpjpe_mm == pytest.approx(0.0, abs=1e-3)
