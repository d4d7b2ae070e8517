import numpy as np
import pytest

from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.footage import read_unit
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import ObservationNoise

SHORT = 0.4


def short(name, **changes):
    return SCENARIOS[name].model_copy(update={"duration": SHORT, **changes})


@pytest.fixture(scope="module")
def hard():
    return simulate_scene(short("hard"), 1)


def moving(folder):
    with np.load(folder / "reference" / "cameras" / "clip.npz") as file:
        return {name: file[name] for name in file}


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_makes_a_match(name, tmp_path):
    scenario = short(name)
    spec = simulate_match(
        scenario, 2, tmp_path / name, MatchOptions(duration=SHORT, cameras=4, stills=False)
    )
    read = read_match(tmp_path / name)
    assert read.spec == spec
    frames = round(SHORT * scenario.fps)
    for camera in spec.static_cameras:
        people, calibration = read_unit(read, camera.id)
        assert (calibration is not None) == (name == "hard")
        assert len(people.frame) == frames
        clicks = read.clicked[camera.id]
        assert len(clicks.points) + len(clicks.drawn) > 1
    if scenario.broadcast is not None:
        people, calibration = read_unit(read, "clip")
        assert calibration is None
        assert len(people.frame) == frames
        assert np.isfinite(people.score).sum(axis=1).mean() > 1.0
        assert {name: array.shape for name, array in moving(tmp_path / name).items()} == {
            "K": (frames, 3, 3),
            "k": (frames, 5),
            "R": (frames, 3, 3),
            "t": (frames, 3),
        }


def test_the_same_seed_gives_the_same_bytes_with_everything_switched_on(tmp_path):
    contents = []
    for name in ("a", "b"):
        simulate_match(short("hard"), 3, tmp_path / name, MatchOptions(cameras=3, stills=False))
        contents.append(
            {
                path.relative_to(tmp_path / name).as_posix(): path.read_bytes()
                for path in sorted((tmp_path / name).rglob("*"))
                if path.is_file()
            }
        )
    assert contents[0] == contents[1]


def test_the_moving_camera_is_written_as_it_filmed(tmp_path):
    scenario = short("broadcast-zoom", noise=ObservationNoise.none())
    simulate_match(scenario, 1, tmp_path / "m", MatchOptions(cameras=1, stills=False))
    scene = simulate_scene(
        scenario.model_copy(update={"rig": scenario.rig.model_copy(update={"cameras": 1})}), 1
    )
    camera = moving(tmp_path / "m")
    identity = scene.identities["clip"].person
    people, _ = read_unit(read_match(tmp_path / "m"), "clip")
    for frame in (0, 7, 19):
        one = Camera(
            focal=np.diag(camera["K"][frame])[:2],
            principal_point=camera["K"][frame, :2, 2],
            distortion=camera["k"][frame],
            cam_from_world=Rigid(camera["R"][frame], camera["t"][frame]),
            image_size=np.array([1920, 1080]),
        )
        places = np.flatnonzero(identity[frame] >= 0)
        assert len(places) > 1
        for place in places:
            expected = one.project(scene.truth.joints[frame, identity[frame, place]])
            found = np.isfinite(people.keypoints[frame, place, :, 0])
            # float32 holds pixels below 2048 to 6e-5; the file holds the camera exactly.
            np.testing.assert_allclose(
                people.keypoints[frame, place, found], expected[found], atol=6.2e-5, rtol=0
            )


def test_nothing_of_the_truth_is_where_the_factory_looks(tmp_path):
    simulate_match(short("hard"), 1, tmp_path / "m", MatchOptions(cameras=3, stills=False))
    for file in (tmp_path / "m" / "detections").iterdir():
        with np.load(file) as content:
            assert set(content) == {"frame", "keypoints", "confidence", "boxes", "score"}
    assert {camera.offset_frames for camera in read_match(tmp_path / "m").spec.cameras} == {0.0}
