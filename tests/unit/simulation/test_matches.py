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
