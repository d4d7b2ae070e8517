"""Both sides of a score by data set: what is stated around a folder, who counts, short clips."""

import numpy as np
import yaml

from flows.results.dataset import check, count, stated_rates
from flows.results.evaluation import reference_side, score
from worldpose.body.body_file import OPEN_BODY
from worldpose.body.model import BodyParameters
from worldpose.dataset.benchmark import score_folders
from worldpose.dataset.manifest import write_frame_rates
from worldpose.formats.joints_file import JointTracks, write_joints, write_poses


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
    write_frame_rates(tmp_path / "reference", {"clip": 50.0})
    assert stated_rates(tmp_path / "reference") == {"clip": 50.0}


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
    write_match(tmp_path / "match", "static")
    np.testing.assert_allclose(told(), [[1, 10.0]] * 2)
    write_match(tmp_path / "match", "broadcast")
    np.testing.assert_allclose(told(), [[2, 260.0]] * 2)
    assert reference_side(str(reference)).joints.views is None  # which methods are scored against
    # Those of a broadcast camera alone, without a match that says so.
    (tmp_path / "match" / "match.yaml").unlink()
    for one in (0, 1):
        shown = JointTracks(frames, persons, joints, views=np.minimum(views, one))
        write_joints(reference / "joints.npz", shown)
        np.testing.assert_allclose(told(), [[2, 260.0]] * 2)


def test_a_clip_with_nobody_is_checked_counted_and_scored(tmp_path):
    nobody = BodyParameters(np.zeros((0, 1, 10)), *(np.zeros((0, 5, n)) for n in (3, 69, 3)))
    write_poses(tmp_path / "poses" / "a.npz", nobody, OPEN_BODY)
    write_joints(tmp_path / "b.joints.npz", JointTracks(np.arange(5), np.arange(0), standing(5, 0)))
    assert [(one.frames, one.persons) for one in check(tmp_path).clips.values()] == [(5, 0)] * 2
    assert count([tmp_path]).poses == 0
    (scores,), _ = score_folders(tmp_path, {"same": tmp_path})
    assert (scores.evaluation.persons, scores.evaluation.g_mpjpe_mm) == (0, None)
