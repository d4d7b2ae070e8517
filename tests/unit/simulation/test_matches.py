import numpy as np
import pytest

from worldpose.ingest.footage import read_unit
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene

TINY = SCENARIOS["tiny"]


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


SHORT = 0.4


def short(name, **changes):
    return SCENARIOS[name].model_copy(update={"duration": SHORT, **changes})


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_makes_a_match(name, tmp_path):
    scenario = short(name)
    spec = simulate_match(
        *(scenario, 2, tmp_path / name),
        MatchOptions(duration=SHORT, cameras=4, stills=False, video=False),
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
    assert len(read.spec.broadcast_views) == len(scenario.broadcast)
    for view in read.spec.broadcast_views:
        people, calibration = read_unit(read, view)
        assert calibration is None
        assert len(people.frame) == frames
        assert np.isfinite(people.score).sum(axis=1).mean() > 1.0
        camera = np.load(tmp_path / name / "reference" / "cameras" / f"{view}.npz")
        assert camera["K"].shape == camera["R"].shape == (frames, 3, 3)
