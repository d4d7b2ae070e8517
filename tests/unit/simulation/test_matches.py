import numpy as np
import pytest

from worldpose.formats.joints_file import read_joints
from worldpose.ingest.footage import read_still, read_unit
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene

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
    simulate_match(TINY, 1, folder, MatchOptions(stills=False))
    return folder


@pytest.fixture(scope="module")
def scene():
    return simulate_scene(TINY, 1)


def test_the_folder_is_a_match_with_clicks_detections_and_a_surveyed_pitch(match, scene):
    read = read_match(match)
    assert read.spec.match_id == "tiny-1"
    assert read.calibrations == {}
    assert not (match / "stills").exists()
    assert read.pitch == scene.surveyed
    for name, observations in scene.observations.items():
        people, _ = read_unit(read, name)
        np.testing.assert_array_equal(people.keypoints, observations.keypoints)
    assert read.clicked == {name: clicks.markings for name, clicks in scene.clicks.items()}


def test_stills_are_of_the_first_frame_and_the_same_seed_gives_the_same_bytes(tmp_path):
    rig = TINY.rig.model_copy(update={"image_size_px": (320, 180), "person_height_px": 16.0})
    small = TINY.model_copy(update={"rig": rig})
    for name, seed in (("a", 1), ("b", 1), ("other", 2)):
        simulate_match(small, seed, tmp_path / name, MatchOptions(duration=0.4, cameras=2))
    spec = read_match(tmp_path / "a").spec
    for camera in spec.static_cameras:
        assert camera.still == f"stills/{camera.id}.png"
        picture = read_still(tmp_path / "a" / camera.still, (320, 180))
        assert picture.std() > 5.0  # not one colour
    assert spec.camera("broadcast").still is None
    one, again, other = (content(tmp_path / name) for name in ("a", "b", "other"))
    assert one == again
    assert other.keys() == one.keys()
    for file in ("detections/cam00.npz", "pitch.json", "stills/cam00.png", "match.yaml"):
        assert other[file] != one[file]


def test_the_truth_is_beside_it(match, scene):
    truth = read_joints(match / "reference" / "joints.npz")
    np.testing.assert_array_equal(truth.joints, scene.truth.joints)
    np.testing.assert_array_equal(truth.views, scene.truth.views)
    assert truth.person_ids.tolist() == [0, 1, 2, 3, 4]
    defined = read_joints(match / "reference" / "defined_joints.npz")
    np.testing.assert_array_equal(defined.joints, scene.defined)
    np.testing.assert_array_equal(defined.views, truth.views)
    for name, camera in scene.cameras.items():
        with np.load(match / "reference" / "cameras" / f"{name}.npz") as file:
            np.testing.assert_array_equal(file["R"][0], camera.cam_from_world.rotation)
            np.testing.assert_array_equal(file["t"][0], camera.cam_from_world.translation)
        with np.load(match / "reference" / "identities" / f"{name}.npz") as file:
            np.testing.assert_array_equal(file["frame"], np.arange(100))
            np.testing.assert_array_equal(file["person"], scene.identities[name].person)
            assert file["person"].dtype == np.int16
