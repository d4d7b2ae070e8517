"""A venue names its cameras: a match of it that calls them otherwise has these names."""

import shutil

import pytest
import yaml
from command_line import succeed, worldpose
from run_records import match_spec

from flows.layers import read_folder, write_layer
from flows.registering import open_match, open_stored, register
from flows.service.inbox import take_in
from flows.service.layout import StateFolder
from flows.web.draft_folder import build
from worldpose.errors import InputError
from worldpose.ingest.camera_names import names_of_spec, rename_cameras
from worldpose.ingest.match_folder import read_match
from worldpose.store.store import Store

OLD = {f"stand-{n}": f"cam{n:02}" for n in range(6)}


@pytest.fixture
def at(tiny, tmp_path):
    """A store, and a match folder of its venue in the inbox."""
    folder = shutil.copytree(tiny, tmp_path / "in" / "m")
    text = yaml.safe_load((folder / "match.yaml").read_text())
    (folder / "match.yaml").write_text(yaml.safe_dump({**text, "match_id": "m", "venue": "parken"}))
    store = Store.create(tmp_path / "project")
    write_layer(store, "venues/parken", {"cameras": OLD, "sides": {"stand-1": "far"}})
    return store, folder


def test_the_inbox_and_a_page_name_cameras_by_one_rule_in_all_parts(at, tmp_path):
    (store, folder), state = at, StateFolder(tmp_path)
    before, new = read_match(folder), {own: name for name, own in OLD.items()}
    for _ in range(2):
        take_in(store, state, tmp_path / "in", 0.0, lambda *_: "run")
    match = open_match(store, "m")
    assert match.registration.spec == rename_cameras(before, new).spec
    assert [it.id for it in match.folder.spec.static_cameras] == [*OLD]
    assert match.folder.spec.camera("stand-1").side == "far"
    for part in ("detections", "clicked", "stills"):
        found = {new.get(own, own): it for own, it in getattr(before, part).items()}
        assert getattr(match.folder, part) == found, part
    content = yaml.safe_load((folder / "match.yaml").read_text()) | {"match_id": "n"}
    (tmp_path / "draft" / "match" / "videos").mkdir(parents=True)
    shutil.move(folder, own := tmp_path / "draft" / "own")
    text = (own / "reference" / "calibration.toml").read_text().replace("cam0", "stand-")
    (tmp_path / "draft" / "given").mkdir()
    (tmp_path / "draft" / "given" / "venue.toml").write_text(text)
    assert open_stored(store, "m").folder.detections.keys() == match.folder.detections.keys()
    _, notes = build(store, content, tmp_path / "draft", {})
    assert f"calibration of {', '.join(OLD.values())}" in notes
    assert "cam00 is stand-0 at the venue" in notes


def test_an_import_states_its_venue_and_a_calibration_may_have_its_names(at, tmp_path):
    (store, folder), out = at, tmp_path / "made"
    given = ("--calibration", folder / "reference" / "calibration.toml", "--fps", 25)
    given += ("--detections", folder / "detections", "--out", out, "--unit", "m", "--up", "z")
    given += ("--project", store.url)
    answer = worldpose("import", *given, "--venue", "other")
    assert answer.code == 1 and "venue other: expected its settings" in answer.err
    succeed("import", *given, "--venue", "parken")
    text = (out / "calibration.toml").read_text()
    for said in (text, text.replace("cam0", "stand-")):
        (out / "calibration.toml").write_text(said)
        found = read_folder(store, out).calibrations
        assert {name: it.id for name, it in found.items()} == {name: name for name in OLD}


@pytest.mark.parametrize(
    ("patterns", "found"),
    [
        ({"a": "*", "b": "cam*"}, "one name whose pattern fits cam00, found a, b"),
        ({"a": "cam*"}, "cameras: a: expected one camera whom it names, found cam00, cam01"),
        ({"cam01": "cam00"}, "cameras: cam01: expected one camera whom it names, found cam00"),
        ({"clip": "cam00"}, "match.yaml, with the names of the venue.*used twice.*clip"),
    ],
)
def test_ambiguous_names_are_refused(at, patterns, found):
    write_layer(at[0], "venues/parken", {"cameras": patterns})
    with pytest.raises(InputError, match=found):
        register(*at)


def test_names_of_videos_count_and_a_name_of_the_venue_stays():
    spec = match_spec({"left": {"video": "videos/cam-03_a.mp4"}, "far": {}, "x": {}})
    assert names_of_spec(spec, {"main": "cam-03*", "far": "x?"}) == {"left": "main"}
    with pytest.raises(InputError, match="fits left, found main, far"):
        names_of_spec(spec, {"main": "cam-03*", "far": "*"})
