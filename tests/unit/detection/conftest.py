"""An image of simulated people, which tests of several nets look at."""

import pytest

from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.training.labels import read_picture


@pytest.fixture(scope="session")
def still(tmp_path_factory):
    folder = tmp_path_factory.mktemp("still") / "tiny"
    options = MatchOptions(duration=0.04, cameras=2, video=False)
    simulate_match(SCENARIOS["tiny"], 5, folder, options)
    return read_picture(sorted((folder / "stills").iterdir())[0])
