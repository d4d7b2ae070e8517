"""A small match to put into inboxes."""

import shutil

import pytest

from worldpose.synthetic import SCENARIOS, simulate_match


@pytest.fixture(scope="session")
def small_match(tmp_path_factory):
    """A match folder of three cameras and two people; read only."""
    folder = tmp_path_factory.mktemp("arriving") / "small"
    tiny = SCENARIOS["tiny"]
    small = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}
    simulate_match(tiny, 0, folder, **small)
    return folder


@pytest.fixture
def drop(small_match, tmp_path):
    """A function that puts a copy of the match into the inbox."""
    (tmp_path / "inbox").mkdir()

    def copy(name="small"):
        return shutil.copytree(small_match, tmp_path / "inbox" / name)

    return copy
