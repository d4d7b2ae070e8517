"""A task computes what its key stands for, or refuses."""

import shutil

import pytest
from prefect.states import Failed

from flows.match import task_of
from flows.method import METHOD
from flows.planning import plan_run, plan_stage
from flows.registering import register
from flows.run_record import RunLog
from tasks.ingest import ingest
from tasks.unit import unit_task
from worldpose.errors import CorruptionError, InputError, StoreError
from worldpose.store import Store


@pytest.fixture
def planned(tiny, tmp_path):
    """A store, a match of its own folder, and the plan of its first camera."""
    store = Store.create(tmp_path / "project")
    match, _ = register(store, shutil.copytree(tiny, tmp_path / "match"))
    return store, match, plan_run(store, match, {})[0]


@pytest.mark.parametrize("stage", METHOD, ids=lambda stage: stage.name)
def test_every_stage_has_its_task(stage):
    assert task_of(stage).fn.__name__ == stage.name


def test_an_edit_after_planning_does_not_reach_the_result(planned, tmp_path):
    store, match, unit = planned
    calibration = tmp_path / "match" / "calibration.toml"
    text = calibration.read_text()
    calibration.write_text(text.replace("translation = [", "translation = [1", 1))
    assert calibration.read_text() != text
    ingest.fn(unit.work(store.url, match, "0001"))
    stored = store.open_result(match.match_id, "ingest", unit.recipe.unit, unit.key)
    planned_translation = unit.recipe.sources["calibration"]["translation"]
    assert stored["translation"].values.tolist() == pytest.approx(planned_translation)


def test_detections_that_changed_after_planning_are_refused(planned, tmp_path):
    store, match, unit = planned
    others = sorted((tmp_path / "match" / "detections").iterdir())
    shutil.copy(others[1], others[0])
    with pytest.raises(InputError, match="registered when the run began"):
        ingest.fn(unit.work(store.url, match, "0001"))
    assert not store.has(match.match_id, "ingest", unit.recipe.unit, unit.key)


@pytest.mark.parametrize(("part", "name"), [("code", "worldpose.errors"), ("libraries", "numpy")])
def test_a_worker_with_other_code_refuses(planned, part, name):
    store, match, unit = planned
    others = getattr(unit.recipe, part) | {name: "another"}
    recipe = unit.recipe.model_copy(update={part: others})
    work = unit.work(store.url, match, "0001").model_copy(update={"recipe": recipe})
    with pytest.raises(InputError, match=f"others in {name}"):
        ingest.fn(work)


@pytest.mark.parametrize(
    ("failure", "retried"),
    [
        (StoreError("disk full"), True),
        (OSError("connection lost"), True),
        (CorruptionError("flipped byte"), False),
        (InputError("x", expected="a", found="b", todo="c"), False),
        (ValueError("a bug"), False),
    ],
)
def test_what_may_pass_is_tried_again(failure, retried):
    task = unit_task(lambda work: work.key)
    assert task.retry_condition_fn(task, None, Failed(data=failure)) is retried


def test_units_behind_a_failed_one_are_recorded_as_blocked(planned):
    store, match, first = planned
    log = RunLog.begin(store, match, METHOD, {})
    for stage in METHOD:
        plan = plan_stage(store, match, stage, {}, log.results)
        log.blocked += plan.blocked
        for unit in plan.units:
            if unit.name != first.name:
                ingest.fn(unit.work(store.url, match, log.run_id))
            log.finished(unit, RuntimeError("x") if unit.name == first.name else None)
    record = log.close()
    assert record.state == "failed"
    assert [failure.unit for failure in record.failed] == [first.name]
    assert record.blocked == ("tracking/clip", "triangulation/clip")


def test_a_run_until_a_stage_is_partial_when_some_of_its_units_are_there(planned):
    store, match, first = planned
    log = RunLog.begin(store, match, METHOD[:1], {})
    for unit in plan_stage(store, match, METHOD[0], {}, {}).units:
        if unit.name != first.name:
            ingest.fn(unit.work(store.url, match, log.run_id))
        log.finished(unit, RuntimeError("x") if unit.name == first.name else None)
    assert log.close().state == "partial"
