"""Redetection depends on the previous iteration, and does not exist for given 2D poses."""

import pytest
from filmed import write_filmed
from test_iteration import LATER, keys
from test_refitting import halves

from flows.registering import register
from flows.stages.filtering import REDETECTION
from worldpose.store.store import Store


@pytest.fixture
def filmed(tmp_path):
    """A folder with two clips of two cameras' videos."""
    folder = tmp_path / "match"
    greys = {"left": [0] * 12, "right": [10] * 12}
    write_filmed(folder, greys, [("first", 0, 5), ("second", 6, 5)])
    return Store.create(tmp_path / "project"), folder


def test_detections_stay_and_all_later_stages_are_made_from_those_found_again(filmed):
    store, folder = filmed
    units = keys(store, folder, 3)
    assert not any(name.startswith("redetection") for number, name in units if number == 1)
    for (number, name), unit in units.items():
        if number == 1:
            continue
        stage, _, which = name.partition("/")
        if stage == "detection":
            assert unit.key == units[1, name].key
        if stage == "redetection":
            clip = which.partition(".")[2]
            assert unit.recipe.inputs[f"detection/{which}"] == units[1, f"detection/{which}"].key
            for before in (f"filtering/{clip}", f"body_fitting/{clip}", f"tracking/{clip}"):
                assert unit.recipe.inputs[before] == units[number - 1, before].key
        if stage in (*LATER, "filtering"):
            mine = {each for each in unit.recipe.inputs if each.startswith("redetection/")}
            clips = ("first", "second") if which == "cameras" else (which,)
            wanted = {f"redetection/{cam}.{clip}" for cam in ("left", "right") for clip in clips}
            assert mine == wanted
            assert all(unit.recipe.inputs[each] == units[number, each].key for each in mine)


def test_of_given_poses_nobody_is_looked_for(tiny, tmp_path):
    match, _ = register(Store.create(tmp_path / "project"), halves(tiny, tmp_path / "match"))
    assert REDETECTION.units(match) == ()
