"""A project of an earlier version opens: its runs, corrections, verdicts and pins apply.

`earlier_project.json` is what a version wrote in November 2026, when settings had other names and
cameras were not compared: one run of six cameras with two `--set`, two corrections, a rejection and
an approval, and a pin, reduced to three units and a few modules of code. Results have no arrays.
"""

import json
from datetime import timedelta
from pathlib import Path

import pytest
from command_line import TINY, succeed
from stand_ins import publish_stand_in

from data_contracts.work import Recipe
from flows import renames
from flows.gates import Gatekeeper
from flows.lineage import explain_unit, find_run, run_difference
from flows.method import METHOD
from flows.registering import open_match, register
from flows.run_plan import PlannedUnit, plan_run
from flows.run_record import latest_run
from flows.run_status import run_status
from worldpose.store import Store, plan_gc, recipe_key, verify
from worldpose.store.documents import canonical_json, digest

EARLIER = json.loads((Path(__file__).parent / "earlier_project.json").read_text())
CAMERA = "static_calibration/cam03"
APPROVED = "static_calibration.cam03.99dfcf4af00d"
"""The request about the camera after its click was removed."""
PRESENT = {
    "body_fitting": {renames.SETTINGS["body_fitting"]["longest_gap"]: 0.5},
    "tracking": {renames.SETTINGS["tracking"]["max_lost"]: 2.5},
}
"""The settings given as `--set longest_gap` and `--set max_lost`, under their present names."""


def seal_fields(fields):
    """A document with exactly these fields, and its checksum."""
    checksum = digest(canonical_json(fields))
    return canonical_json({**fields, "checksum": checksum}) + b"\n", checksum


@pytest.fixture
def store(tiny, tmp_path):
    """The earlier project, of the match `tiny`."""
    earlier = json.loads(json.dumps(EARLIER).replace(EARLIER["run"]["match_id"], TINY))
    store = Store.create(str(tmp_path / "project"))
    store.blobs.put("project.json", seal_fields(earlier["project"])[0])
    match, _ = register(store, tiny)
    run, contents = earlier["run"], {}
    for name, fields in earlier["recipes"].items():
        stage, _, unit = name.partition("/")
        fields["inputs"] = {
            each: run["results"][each] for each in fields["inputs"] if each in earlier["recipes"]
        }
        recipe = Recipe.model_validate(fields)
        run["results"][name] = key = recipe_key(recipe)
        publish_stand_in(store, match, PlannedUnit(recipe, key, published=False))
        contents[name] = store.manifest(TINY, stage, unit, key).content
    store.blobs.put(f"runs/{TINY}/{run['run_id']}.json", seal_fields(run)[0])
    clicked = match.folder.clicked["cam03"].points[0]
    previous = None
    for number, entry in enumerate(earlier["reviews"], 1):
        entry["previous"] = previous
        for record in entry["records"]:
            if record["kind"] == "request" and record["id"] == APPROVED:
                record["contents"] = {CAMERA: contents[CAMERA]}
            elif record["kind"] == "correction" and record["edit"]["kind"] == "moved_point":
                record["edit"] |= {"marking": clicked.name, "was": list(clicked.xy)}
        document, previous = seal_fields(entry)
        store.blobs.put(f"reviews/{TINY}/{number:06d}.json", document)
    pin = earlier["pin"]
    store.blobs.put(f"pins/{TINY}/{pin['name']}.json", seal_fields(pin)[0])
    return store


def test_every_byte_is_as_it_was_published(store):
    assert verify(store) == ()


def test_all_settings_of_the_run_are_read_under_their_present_names(store):
    record = latest_run(store, TINY)
    for stage in METHOD:
        if stage.name in record.settings:  # else the stage is newer
            stage.settings.model_validate(record.settings[stage.name])
    assert record.overrides == PRESENT
    planned = {unit.name: unit for unit in plan_run(store, open_match(store, TINY), PRESENT)}
    for stage, asked in PRESENT.items():
        assert asked.items() <= planned[f"{stage}/clip"].recipe.settings.items()


def test_corrections_apply_to_what_is_computed_now(store):
    match = open_match(store, TINY)
    assert [each.edit.kind for each in match.corrections] == ["moved_point", "named_track"]
    assert match.stale == ()
    units = {unit.name: unit.recipe for unit in plan_run(store, match, {})}
    edit = match.corrections[0].edit
    (clicked,) = units[CAMERA].sources["clicked"].values()
    assert clicked["points"]
    assert edit.marking not in clicked["points"]
    (named,) = units["tracking/clip"].sources["identities"]
    assert named["name"] == "home-7"


def test_what_would_be_recomputed_is_told_without_former_names(store):
    found = run_status(store, TINY)
    assert found.is_stale
    assert {unit.name for unit in found.to_compute} >= set(EARLIER["run"]["results"])
    for name in EARLIER["run"]["results"]:
        former = set(renames.SETTINGS[name.partition("/")[0]])
        explained = explain_unit(store, f"{TINY}/{name}", {})
        assert explained.state == "stale"
        told = [line.strip() for line in explained.reasons]
        assert any(line.startswith("module ") for line in told)  # other code is the reason
        settings = [line.split()[1].rstrip(":") for line in told if line.startswith("setting ")]
        assert not former & {setting.split("[")[0] for setting in settings}, settings


def test_a_verdict_is_valid_for_a_new_computation_of_the_same_bytes_alone(store):
    match = open_match(store, TINY)
    unit = next(each for each in plan_run(store, match, {}) if each.name == CAMERA)
    publish_stand_in(store, match, unit)  # the bytes that Ada approved, under another key
    gates = Gatekeeper(store, match, "always")
    assert gates.list_held_units("static_calibration", {CAMERA: unit.key}) == ()
    other = unit.recipe.model_copy(update={"libraries": {}})
    other = PlannedUnit(other, recipe_key(other), published=False)
    publish_stand_in(store, match, other, files=("zarr.json", "c/0"))
    (waiting,) = gates.list_held_units("static_calibration", {CAMERA: other.key})
    assert not waiting.rejected
    assert waiting.request != APPROVED


def test_a_pinned_run_is_found_by_its_name_and_kept(store):
    assert find_run(store, f"{TINY}/first").run_id == "0004"
    pinned = store.run(TINY)
    store.finish_run(pinned.model_copy(update={"run_id": "0005", "parent": "0004", "results": {}}))
    at_once = {"keep_last": 1, "older_than": timedelta(0)}
    assert plan_gc(store, **at_once).garbage == ()
    store.blobs.delete(f"pins/{TINY}/first.json")
    assert len(plan_gc(store, **at_once).garbage) == 1 + len(pinned.results)


def test_runs_of_two_versions_are_compared_without_former_names(store):
    record, match = store.run(TINY), open_match(store, TINY)
    planned = {
        unit.name: unit for unit in plan_run(store, match, latest_run(store, TINY).overrides)
    }
    units = [planned[name] for name in record.results]
    for unit in units:
        publish_stand_in(store, match, unit)
    new = record.model_copy(
        update={"run_id": "0005", "results": {unit.name: unit.key for unit in units}}
    )
    for change in run_difference(store, record, new):
        assert change.state == "changed"
        former = set(renames.SETTINGS[change.unit.partition("/")[0]])
        settings = [line.split()[1].rstrip(":") for line in change.reasons if "setting " in line]
        assert not former & set(settings), settings


def test_the_commands_open_it(store):
    said = succeed("status", "--project", store.url).out
    assert "run 0004 is pinned as first" in said
    assert str(PRESENT) in said
    assert "applied" in succeed("review", "show", TINY, "--project", store.url).out
