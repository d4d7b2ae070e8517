"""The starting point of a run of some stages: the pass and the settings of its inputs."""

import pytest
from stand_ins import publish_stand_in
from test_refitting import halves

from flows.gates import Gatekeeper
from flows.registering import register
from flows.run_plan import RunPlan, plan_run
from flows.run_record import RunLog, latest_run
from flows.settings import parse_overrides, selected_stages
from worldpose.errors import UsageError
from worldpose.store.store import Store

OTHER = {"tracking": {"min_joints": 6}}


def iterate(store, match, overrides, passes):
    """Runs of so many passes over the method."""
    stages = selected_stages(None, None)
    for number in range(1, passes + 1):
        for unit in plan_run(store, match, overrides, iteration=number):
            if not unit.published:
                publish_stand_in(store, match, unit)
        log = RunLog.begin(store, match, stages, overrides, iteration=number)
        for stage in stages:
            log.reuse(log.plan.plan_stage(stage))
        log.close()
    return latest_run(store, match.match_id)


@pytest.fixture
def clips(tiny, tmp_path):
    """A store, and a match of two clips."""
    folder = halves(tiny, tmp_path / "match")
    (folder / "calibration.toml").unlink()
    store = Store.create(tmp_path / "project")
    return store, register(store, folder)[0]


@pytest.mark.parametrize("start", ["tracking", "body_fitting"])
def test_a_later_stage_goes_on_with_the_pass_that_the_latest_run_was_made_of(clips, start):
    store, match = clips
    iterate(store, match, {}, 2)
    latest = iterate(store, match, OTHER, 2)
    stages = selected_stages(start, None)
    asked = OTHER if start == "tracking" else {}
    plan = RunPlan.begin(Gatekeeper(store, match, "never"), stages, asked, latest, 1)
    assert plan.iteration == 2
    first = {unit.name: unit.key for unit in plan_run(store, match, OTHER)}
    assert plan.before["filtering/first"] == first["filtering/first"]
    planned = plan.plan_stage(stages[0])
    assert {unit.key for unit in planned} <= set(latest.results.values())
    assert {unit.iteration for unit in planned} == {2}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("detection.stride=true", "true"),
        ("tracking.gate_m=true", "true"),
        ("detection.zooms=[true, 2]", "[true, 2]"),
    ],
)
def test_true_is_no_number(text, found):
    with pytest.raises(UsageError, match="number") as refused:
        parse_overrides([text])
    assert refused.value.found == found
