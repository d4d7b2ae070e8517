"""Stale results of an edit, by match, found without a run."""

import json
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from command_line import TINY, invoke, succeed
from test_iteration import halves

from data_contracts.review import DeletedDetection, MergedTracks, MovedPoint
from data_contracts.run import UnitFailure
from flows import reprocess
from flows.cli.run import exit_code
from flows.layers import PROJECT, write_layer
from flows.method import METHOD
from flows.registering import open_match, register
from flows.reprocess import reprocess_matches
from flows.review.edit_conflicts import edits_since
from flows.review.verdicts import correct
from flows.run_status import explain_unit, run_status
from flows.running import RunRequest
from flows.service import deployed
from flows.stages.tracking import STAGE
from worldpose.errors import InputError, WorldposeError
from worldpose.store.paths import ResultId


def made_from(store, *starts):
    """`starts` and all that the finished run made from them, as its results' manifests tell."""
    results = store.run(TINY).results
    inputs = {
        name: set(store.manifest(TINY, *name.split("/"), key).recipe.inputs)
        for name, key in results.items()
    }
    found = set(starts)
    while True:
        more = {name for name, sources in inputs.items() if sources & found} - found
        if not more:
            return found
        found |= more


def edit_point(store):
    match = open_match(store, TINY)
    clicked = match.folder.clicked["cam02"]
    (x, y) = clicked.points[0].xy
    moved = MovedPoint(camera="cam02", marking=clicked.points[0].name, was=(x, y), xy=(x + 0.5, y))
    correct(store, match, [moved], who="Ada", why="on the line")
    return {}, ["static_calibration/cam02"]


def edit_box(store):
    deleted = DeletedDetection(camera="cam01", frame=5, detection=0)
    correct(store, open_match(store, TINY), [deleted], who="Ada", why="a shadow")
    return {}, ["ingest/cam01"]


def edit_setting(store):
    return {"body_fitting": {"loss_scale": 3.0}}, ["body_fitting/clip"]


@pytest.mark.parametrize("edit", [edit_point, edit_box, edit_setting])
def test_an_edit_makes_what_was_made_from_it_stale_and_nothing_else(store, edit):
    assert not run_status(store, TINY).is_stale
    settings, starts = edit(store)
    found = run_status(store, TINY, settings)
    expected = made_from(store, *starts)
    assert {unit.planned.name for unit in found.units} == expected
    assert len(found.to_compute) == len(expected)
    assert {unit.planned.name for unit in found.units if unit.own_reasons} == set(starts)


def finish(store, **changes):
    """Record a later finished run: a copy of the latest with some fields changed."""
    before = store.run(TINY)
    changes = {"run_id": store.reserve_run(TINY), "parent": before.run_id, **changes}
    store.finish_run(before.model_copy(update=changes))
    return store.run(TINY)


def without(record, *stages):
    return {name: key for name, key in record.results.items() if name.split("/")[0] not in stages}


def test_a_run_that_ended_earlier_is_made_current_as_far_as_it_went(store):
    later = ("bundle_adjustment", "retriangulation", "body_fitting", "filtering")
    finish(store, results=without(store.run(TINY), *later))
    assert not run_status(store, TINY).is_stale
    edit_box(store)
    found = run_status(store, TINY)
    assert found.until_stage == "triangulation"
    assert {unit.planned.name for unit in found.units} >= {"tracking/clip", "triangulation/clip"}


@pytest.mark.parametrize(
    ("error", "again"), [("CorruptionError", False), ("ConnectionResetError", True)]
)
def test_what_failed_is_tried_again_when_something_is_another(store, error, again):
    tracking = store.run(TINY).results["tracking/clip"]
    store.withdraw(ResultId(TINY, "tracking", "clip", tracking))
    failure = UnitFailure(unit="tracking/clip", error=error, message="x", key=tracking)
    later = [stage.name for stage in METHOD[METHOD.index(STAGE) :]]
    results = without(store.run(TINY), *later)
    finish(store, state="failed", results=results, failed=(failure,), figures={}, reused=())
    assert run_status(store, TINY).is_stale == again
    told = f"run {TINY}/0002 failed with the same input and settings: x"
    assert explain_unit(store, f"{TINY}/tracking/clip", {})["reasons"] == (told,)
    if not again:
        said = invoke("reprocess", "--project", store.url).stdout
        assert "nothing was edited since run 0002, which is failed; --retry" in " ".join(
            said.split()
        )
    assert run_status(store, TINY, retry=True).is_stale
    edit_box(store)
    assert "tracking/clip" in {unit.planned.name for unit in run_status(store, TINY).units}


def test_a_later_iteration_is_stale_in_every_pass(store):
    write_layer(store, PROJECT, {"iterations": 2})
    finish(store, iteration=2)
    found = run_status(store, TINY)
    # Nothing of the second pass is there; the first pass stands in the run before.
    assert {unit.planned.iteration for unit in found.units} == {2}
    edit_box(store)
    found = run_status(store, TINY)
    assert {unit.planned.iteration for unit in found.units} == {1, 2}
    assert len({unit.key for unit in found.to_compute}) == len(found.to_compute)


def test_a_result_that_holds_a_withdrawn_edit_is_not_taken_for_one_without_it():
    edits = [MergedTracks(clip="clip", kept=0, merged=person) for person in (1, 2, 3)]
    held = [edit.model_dump(mode="json") for edit in edits[:2]]
    assert edits_since(edits, held, "clip", "match") == edits[2:]
    assert edits_since(edits, [], "clip", "match") == edits
    for standing in (edits[1:], edits[:1], []):
        with pytest.raises(InputError, match="withdrawn"):
            edits_since(standing, held, "clip", "match")


def test_a_match_that_fails_stops_no_other(store, tiny, tmp_path, monkeypatch):
    edit_box(store)
    register(store, halves(tiny, tmp_path / "other"))
    ran, real = [], reprocess.read_summary

    def run(store, match, request):
        ran.append((match.match_id, request.gates, request.workers))
        return store.run(match.match_id)

    def broken(store, match_id):
        if match_id == "halves":
            raise OSError("its folder is gone")
        return real(store, match_id)

    def states(which=(), **how):
        found = reprocess_matches(store, which, RunRequest({}, workers=3), **how)
        return [(each.match_id, each.state, each.problem) for each in found]

    def machines(store, request):
        return nullcontext(lambda missing: request)

    monkeypatch.setattr(reprocess, "run_match", run)
    monkeypatch.setattr(reprocess, "shared_machines", machines)
    assert states() == [("halves", "never run", None), (TINY, "complete", None)]
    assert ran == [(TINY, "never", 3)]
    monkeypatch.setattr(reprocess, "read_summary", broken)
    found = states()
    assert found == [("halves", "failed", "its folder is gone"), (TINY, "complete", None)]
    assert exit_code({state for _, state, _ in found}) == 4
    assert states((TINY,), is_rehearsal=True)[0][1] == "stale"
    assert len(ran) == 2


class Runs:
    """A service's runs, one of which has not ended."""

    def __init__(self, *at_work):
        self.at_work, self.started, self.queue = at_work, [], self

    def open_runs(self):
        return [SimpleNamespace(match_id=each, flow="match") for each in self.at_work]

    def start(self, match_id, **given):
        self.started.append((match_id, given))


def test_the_deployment_starts_a_run_of_each_stale_match_in_the_background(store, monkeypatch):
    runs = Runs()
    monkeypatch.setattr(deployed, "match_runs_of", lambda url: runs)
    assert deployed.reprocess.fn(store.url) == {TINY: "current"}
    edit_box(store)
    write_layer(store, PROJECT, {"tracking.gate_m": 0.5, "gates": "always"})
    assert deployed.reprocess.fn(store.url) == {TINY: "started"}
    nothing = dict.fromkeys(("settings", "until_stage", "time_limits"))
    assert runs.started == [(TINY, {"priority": "background", "gates": "always", **nothing})]
    runs.at_work = (TINY,)
    assert deployed.reprocess.fn(store.url) == {TINY: "has a run"}
    assert len(runs.started) == 1
    monkeypatch.setattr(deployed, "match_runs_of", lambda url: None)
    with pytest.raises(WorldposeError, match="is not served on this machine"):
        deployed.reprocess.fn(store.url)


def test_the_exit_code_says_how_far_it_came():
    for states, code in (
        (("current", "never run", "stale", "complete"), 0),
        (("failed",), 1),
        (("waiting", "complete"), 3),
        (("failed", "current"), 4),
        (("partial",), 4),
    ):
        assert exit_code(set(states)) == code


def test_the_command_lists_what_it_would_compute_and_why(store):
    edit_box(store)
    answer = invoke("reprocess", "--dry-run", "--project", store.url)
    assert answer.exit_code == 0
    assert f"{TINY}: stale, run 0001; 8 units to compute" in answer.stdout
    assert "changed inputs: ingest/cam01" in " ".join(answer.stdout.split())
    assert store.runs(TINY) == ("0001",)


def test_a_setting_of_a_stage_that_this_match_lacks_makes_nothing_stale(store):
    here = ("--project", store.url)
    succeed("settings", TINY, "--set", "broadcast_calibration.line_search_px=3.0", *here)
    answer = succeed("reprocess", "--dry-run", "--json", *here).json["matches"]
    assert [each["state"] for each in answer] == ["untouched"]


@pytest.mark.slow
def test_reprocessing_computes_what_was_listed(server, store):
    edit_point(store)
    expected = made_from(store, "static_calibration/cam02")
    answer = succeed("reprocess", "--project", store.url, "--json").json["matches"]
    assert [each["state"] for each in answer] == ["complete"]
    assert set(answer[0]["executed"]) == expected
    assert store.run(TINY).parent == "0001"
    again = succeed("reprocess", "--project", store.url, "--json").json["matches"]
    assert [(each["state"], each["executed"]) for each in again] == [("untouched", [])]


def test_a_match_whose_weights_are_gone_is_a_problem_of_its_own(store, tmp_path):
    gone = tmp_path / "gone.onnx"
    write_layer(store, PROJECT, {"detection.pose": f"onnx:{gone}"})
    status = json.loads(invoke("status", "--project", store.url, "--json").stdout)
    assert str(gone) in json.dumps(status)
