import numpy as np
import pytest

from worldpose.cameras import Camera
from worldpose.errors import InputError
from worldpose.ingest import read_match, read_unit
from worldpose.release import read_joints
from worldpose.synthetic import SCENARIOS, Scenario, simulate_match, simulate_scene

TINY = SCENARIOS["tiny"]


def content(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def match(tmp_path_factory):
    folder = tmp_path_factory.mktemp("matches") / "tiny"
    simulate_match(TINY, 1, folder)
    return folder


@pytest.fixture(scope="module")
def scene():
    return simulate_scene(TINY, 1)


def test_scenarios_are_found_by_their_name():
    assert SCENARIOS
    for name, scenario in SCENARIOS.items():
        assert isinstance(scenario, Scenario)
        assert scenario.name == name
        assert scenario.about


def test_the_same_seed_gives_the_same_bytes(match, tmp_path):
    simulate_match(TINY, 1, tmp_path / "again")
    assert content(tmp_path / "again") == content(match)
    simulate_match(TINY, 2, tmp_path / "other")
    other = content(tmp_path / "other")
    assert other.keys() == content(match).keys()
    assert other["detections/cam00.npz"] != content(match)["detections/cam00.npz"]


def test_the_folder_is_a_match_with_calibration_detections_and_pitch(match, scene):
    read = read_match(match)
    assert read.spec.match_id == "tiny-1"
    assert list(read.calibrations) == list(scene.cameras)
    assert read.pitch == TINY.pitch
    for name, observations in scene.observations.items():
        people, calibration = read_unit(read, name)
        np.testing.assert_array_equal(people.keypoints, observations.keypoints)
        center = Camera.from_calibration(calibration).center
        # The calibration file holds all digits of a rotation vector: rounding at 60 m.
        np.testing.assert_allclose(center, scene.cameras[name].center, atol=1e-9)


def test_the_truth_is_beside_it(match, scene):
    truth = read_joints(match / "reference" / "joints.npz")
    np.testing.assert_array_equal(truth.joints, scene.truth.joints)
    np.testing.assert_array_equal(truth.views, scene.truth.views)
    assert truth.person_ids.tolist() == [0, 1, 2, 3, 4]
    for name, camera in scene.cameras.items():
        with np.load(match / "reference" / "cameras" / f"{name}.npz") as file:
            np.testing.assert_array_equal(file["R"][0], camera.cam_from_world.rotation)
            np.testing.assert_array_equal(file["t"][0], camera.cam_from_world.translation)
        with np.load(match / "reference" / "identities" / f"{name}.npz") as file:
            np.testing.assert_array_equal(file["frame"], np.arange(100))
            np.testing.assert_array_equal(file["person"], scene.identities[name].person)
            assert file["person"].dtype == np.int16


def test_detections_hold_no_identity(match):
    with np.load(match / "detections" / "cam00.npz") as file:
        assert set(file) == {"frame", "keypoints", "confidence", "boxes", "score"}


def test_what_differs_from_the_scenario_is_in_the_id(tmp_path):
    spec = simulate_match(TINY, 3, tmp_path / "m", duration=0.4, cameras=2, players=1)
    assert spec.match_id == "tiny-3-0.4s-2cameras-1players"
    assert [camera.id for camera in spec.cameras] == ["cam00", "cam01"]
    assert spec.clips[0].frame_count == 10
    assert read_joints(tmp_path / "m" / "reference" / "joints.npz").joints.shape == (10, 1, 17, 3)
    assert read_match(tmp_path / "m").spec == spec


def test_an_empty_pitch_is_a_match(tmp_path):
    simulate_match(TINY, 0, tmp_path / "m", duration=0.4, cameras=2, players=0)
    assert read_joints(tmp_path / "m" / "reference" / "joints.npz").joints.shape == (10, 0, 17, 3)


def test_a_folder_with_files_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="left as it was"):
        simulate_match(TINY, 0, tmp_path, duration=0.4, cameras=1, players=1)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
