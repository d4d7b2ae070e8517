"""A run's record when units fail, and when the match is edited during the run."""

from dataclasses import replace

import pytest
from command_line import TINY

from data_contracts.review import MergedTracks
from flows import iterate, run_record
from flows.gates import GATES, IdentityLimits
from flows.iterate import Iteration, iterate_match
from flows.method import METHOD
from flows.registering import open_match
from flows.review.edit_conflicts import EditedMeanwhileError
from flows.review.verdicts import correct
from flows.run_record import RunLog
from flows.run_status import run_status
from flows.running import RunRequest
from worldpose.store.store import Store


@pytest.fixture
def store(project_copy):
    return Store.open(project_copy)


def merge(store):
    """Record the correction that two tracks are one person."""
    edit = MergedTracks(clip="clip", kept=0, merged=1)
    correct(store, open_match(store, TINY), [edit], who="Ada", why="one person")


def recorded(store, stages, failing=None, before_stage=None):
    """A run of `stages` that finds everything in the store, but for what fails."""
    log = RunLog.begin(store, open_match(store, TINY), stages, {})
    for stage in stages:
        if before_stage == stage.name:
            merge(store)
        for unit in log.plan.plan_stage(stage):
            log.finish_unit(unit, RuntimeError("x") if stage.name == failing else None)
    return log.close()


@pytest.mark.parametrize(
    ("failing", "until", "state"),
    [
        ("filtering", "filtering", "partial"),  # the bodies are there
        ("filtering", "refitting", "complete"),  # it was not asked for
        ("body_fitting", "filtering", "failed"),
        # No unit is refitted here: that the last stage has none makes nothing fail.
        ("ingest", "refitting", "failed"),
        ("tracking", "tracking", "failed"),
    ],
)
def test_a_run_with_bodies_is_partial_whatever_fails_after_them(store, failing, until, state):
    names = [stage.name for stage in METHOD]
    record = recorded(store, METHOD[: names.index(until) + 1], failing)
    assert record.state == state
    stages = {failure.unit.split("/")[0] for failure in record.failed}
    assert stages == (set() if state == "complete" else {failing})
    assert all(failure.key is not None for failure in record.failed)


def test_a_run_during_an_edit_has_the_match_as_it_began_and_the_edit_is_seen_next(store):
    before = store.run(TINY)
    record = recorded(store, METHOD, before_stage="tracking")
    assert record.state == "complete"
    assert record.results == before.results, "no unit of the edited match is among the others"
    found = run_status(store, TINY)
    assert found.latest.run_id == record.run_id
    assert {unit.unit for unit in found.units if unit.own_reasons} == {"tracking/clip"}


def test_an_iteration_is_refused_when_the_one_before_is_of_another_state_of_the_match(store):
    match = open_match(store, TINY)
    RunLog.begin(store, match, METHOD, {}, iteration=2)  # the first is there
    merge(store)
    RunLog.begin(store, match, METHOD, {}, iteration=2)  # and stays there for who began earlier
    with pytest.raises(EditedMeanwhileError, match="filtering/clip"):
        RunLog.begin(store, open_match(store, TINY), METHOD, {}, iteration=2)


def test_iterations_begin_again_when_the_match_is_edited_between_two(store, monkeypatch):
    begun = []

    def one_pass(store, match, request, machines_for):
        begun.append((request.iteration, len(match.corrections)))
        if request.iteration == 2 and not match.corrections:
            merge(store)
            raise EditedMeanwhileError("x", expected="a", found="b", todo="c")
        return Iteration(request.iteration, store.run(TINY), None)

    monkeypatch.setattr(iterate, "_pass", one_pass)
    iterate_match(store, open_match(store, TINY), RunRequest({}), 2)
    assert begun == [(1, 0), (2, 0), (1, 1), (2, 1)]


def test_a_run_that_asks_no_person_warns_of_a_result_that_is_probably_wrong(store, monkeypatch):
    assert not [text for text in recorded(store, METHOD).warnings if "may be wrong" in text]
    strict = replace(GATES["tracking"], limits=IdentityLimits(mean_ray_distance_m=0.0))
    monkeypatch.setattr(run_record, "GATES", {"tracking": strict})
    (text,) = (text for text in recorded(store, METHOD).warnings if "may be wrong" in text)
    assert text.startswith(
        "tracking/clip may be wrong: disagreement of the cameras about a person: "
    )
    assert "--gates auto" in text
