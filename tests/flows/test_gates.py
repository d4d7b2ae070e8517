"""A run waits at its gates, continues on approval, and keeps all verdicts and corrections."""

import json
import shutil
from contextlib import suppress
from datetime import UTC, datetime

import pytest
from command_line import TINY, invoke, worldpose

from data_contracts.review import MovedPoint, ReviewDecision
from flows.cli.locate import compute_poses
from flows.gates import GATES, Gatekeeper
from flows.match import IncompleteRunError
from flows.method import METHOD
from flows.registering import open_match, register
from flows.review.verdicts import decide, origins_of, reviews_of, still_waiting, withdraw
from flows.run_plan import plan_run
from flows.run_record import latest_run
from flows.running import RunRequest, run_match
from flows.service import deployed
from worldpose.errors import InputError
from worldpose.ingest.writing import write_offsets
from worldpose.review.journal import say
from worldpose.store.integrity import verify

WRONG = "static_calibration/cam03"
"""The camera of `tiny` with a click that the others contradict."""


def run(store, gates, **keywords):
    return run_match(store, open_match(store, TINY), RunRequest({}, gates=gates, **keywords))


def approve(store, *requests, verdict="approve", edits=()):
    ids, _ = decide(
        store, open_match(store, TINY), requests, verdict, who="Ada", why="looked", edits=edits
    )
    return ids


def units(waiting):
    return [unit.unit for unit in waiting]


def wrong_click(match):
    """An edit that removes a click of the camera that has a wrong one."""
    name = match.folder.clicked["cam03"].points[0].name
    return MovedPoint(camera="cam03", marking=name, xy=None)


def test_auto_waits_for_the_results_beyond_a_limit_and_goes_on_when_they_are_approved(store):
    record = run(store, "auto")
    assert (record.run_id, record.state, record.gates) == ("0002", "waiting", "auto")
    reasons = {unit.unit: unit.reasons for unit in record.waiting}
    assert "clicks_wrong is 1, at most 0 passes" in reasons[WRONG]
    # The others are within the limits of which the calibration page warns.
    assert {*reasons} == {WRONG, "static_calibration/cam04"}
    # Everything behind them has a result from before, and may not be built upon.
    assert {name.partition("/")[0] for name in record.results} == {"ingest", "static_calibration"}
    assert {name.partition("/")[0] for name in record.blocked} >= {"tracking", "body_fitting"}
    reviews = {each.request.id: each for each in reviews_of(store, open_match(store, TINY), record)}
    assert set(reviews) == {unit.request for unit in record.waiting}
    assert {(each.state, each.request.run_id) for each in reviews.values()} == {("waits", "0002")}
    assert verify(store) == ()
    # Asked again, it waits for the same, and neither a run nor a question is added.
    assert run(store, "auto").run_id == "0002"
    assert len(store.blobs.entries("reviews")) == 1
    first, *others = reviews
    approve(store, first)
    left = still_waiting(store, open_match(store, TINY), latest_run(store, TINY))
    assert units(left) == [each.unit for each in record.waiting if each.request != first]
    assert len(run(store, "auto").waiting) == len(others)
    approve(store, *others)
    record = run(store, "auto")
    assert (record.run_id, record.state, record.executed) == ("0004", "complete", ())
    assert record.results == store.run(TINY, "0001").results


def test_a_part_of_the_method_keeps_the_questions_and_the_policy_of_a_run_that_waits(store):
    waits = run(store, "auto")
    part = RunRequest({}, until_stage="detection")
    found = compute_poses(store, open_match(store, TINY), 1, part).record
    assert units(found.waiting) == units(waits.waiting)
    assert latest_run(store, TINY) == waits
    while (later := units(run(store, "always").waiting)) != ["tracking/clip"]:
        approve(store)
    run_match(store, open_match(store, TINY), part)
    latest = latest_run(store, TINY)
    assert (latest.gates, units(latest.waiting)) == ("always", later)
    # Where a part ended without a question, the run to the end asks as it was begun.
    run(store, "always", until_stage="ingest", from_stage="ingest")
    approve(store)
    run(store, "always", until_stage="ingest")
    assert run(store, None).gates == "always"


def test_a_part_before_the_questions_adds_one_record_at_most_and_keeps_them(store, monkeypatch):
    waits, begun = run(store, "auto"), []
    found = run(store, None, until_stage="ingest")
    assert (found.run_id, found.waiting) == (waits.run_id, waits.waiting)

    def no_machines(log, limits):
        begun.append(log.run_id)
        return log.run_stages(lambda stage, units: ())

    monkeypatch.setattr(deployed, "run_stages", no_machines)
    part = RunRequest({}, until_stage="ingest", gates="auto")
    assert deployed._run_until_decided(store, TINY, part)[1] == waits
    # A run of which only a later stage asks anything ends as well.
    later = {"run_id": store.reserve_run(TINY), "overrides": {"ingest": {}}}
    store.finish_run(waits.model_copy(update=later))
    _, record = deployed._run_until_decided(store, TINY, part)
    assert begun == [record.run_id] and record.waiting == waits.waiting


def test_a_run_that_waited_is_exported_as_the_version_that_it_then_took(
    store, tmp_path, monkeypatch
):
    ended = run(store, "auto").model_copy(update={"state": "complete", "waiting": ()})
    before, exported = open_match(store, TINY).folder.folder, []

    def decide_after_next_version(*_):
        after = shutil.copytree(before, tmp_path / "v2")
        write_offsets(after, {"cam02": 1})
        register(store, after, replaces=str(before))

    monkeypatch.setattr(deployed, "take_verdict", decide_after_next_version)
    monkeypatch.setattr(deployed, "run_stages", lambda log, limits: ended)
    export = lambda store, match, record: exported.append(match.folder.folder.name)  # noqa: E731
    monkeypatch.setattr(deployed, "export_after_run", export)
    with suppress(IncompleteRunError):
        deployed.match.fn(store.url, TINY, gates="auto")
    assert exported == ["v2"]


def test_the_policy_is_kept_where_a_unit_failed(store):
    waits, match = run(store, "auto"), open_match(store, TINY)
    for waiting in (waits.waiting, ()):
        failed = waits.model_copy(update={"state": "failed", "waiting": waiting})
        assert RunRequest({}).gate_policy(match, failed) == "auto"
    complete = waits.model_copy(update={"state": "complete", "waiting": ()})
    assert RunRequest({}).gate_policy(match, complete) == "never"


def test_what_no_run_waits_for_any_more_is_not_listed(store):
    run(store, "auto")
    latest = run(store, "never")
    assert (latest.run_id, latest.state) == ("0003", "complete")
    reviews = reviews_of(store, open_match(store, TINY), latest)
    assert reviews and {each.state for each in reviews} == {"superseded"}
    with pytest.raises(InputError, match="nothing that waits"):
        approve(store)


@pytest.mark.slow
def test_always_asks_behind_every_gate_in_turn(store):
    asked = []
    units_of = {stage.name: stage.units(open_match(store, TINY)) for stage in METHOD}
    gates = [gate.stage for gate in GATES.values() if units_of[gate.stage]]
    for _ in gates:
        record = run(store, "always")
        assert record.state == "waiting"
        (stage,) = {unit.partition("/")[0] for unit in units(record.waiting)}
        asked.append(stage)
        assert len(approve(store)) == len(record.waiting)  # all that wait
    assert (asked, run(store, "always").state) == (gates, "complete")
    assert run(store, "always").run_id == latest_run(store, TINY).run_id


def test_a_verdict_holds_for_the_bytes_whatever_key_gives_them(store):
    """A setting that changes nothing of a camera changes its key; its approval stands."""
    run(store, "auto")
    approve(store)
    match = open_match(store, TINY)
    results = store.run(TINY, "0001").results
    manifest = store.manifest(TINY, "static_calibration", "cam03", results[WRONG])

    class Twin:
        """The store, with the same result under another key."""

        def manifest(self, *place):
            return manifest

    gatekeeper = Gatekeeper(Twin(), match, "auto")
    assert gatekeeper.list_held_units("static_calibration", {WRONG: "f" * 32}) == ()
    changed = manifest.model_copy(update={"content": "0" * 64})
    Twin.manifest = lambda self, *place: changed
    assert units(gatekeeper.list_held_units("static_calibration", {WRONG: "f" * 32})) == [WRONG]


def test_what_was_approved_is_asked_again_only_if_it_got_worse(store, monkeypatch):
    key = store.run(TINY, "0001").results[WRONG]
    manifest = store.manifest(TINY, "static_calibration", "cam03", key)
    good = dict.fromkeys(GATES["static_calibration"].limits, 0.0)

    def shown(self, name, key):
        """A result whose error is in the last letter of its key, in tenths of a metre."""
        figures = good | {"expected_ground_error_median_m": int(key[-1]) / 10}
        figures["clicks_wrong"] = float(key[0] == "c")
        return manifest.model_copy(update={"content": key * 2, "figures": figures})

    monkeypatch.setattr(Gatekeeper, "_manifest", shown)

    def held(key):
        keeper = Gatekeeper(store, open_match(store, TINY), "auto")
        return keeper, keeper.list_held_units("static_calibration", {WRONG: key})

    first = "a" * 31 + "3"
    keeper, (unit,) = held(first)
    keeper.ask("0001", [unit], {WRONG: first})
    given = {"match_id": TINY, "request": unit.request, "verdict": "approve", "who": "Ada"}
    verdict = ReviewDecision(**given, decided_at=datetime.now(UTC))
    say(store, TINY, lambda journal: [verdict])
    asked = {key: bool(held(key)[1]) for key in (f"{'b' * 31}3", f"{'b' * 31}4", f"{'c' * 31}3")}
    assert list(asked.values()) == [False, True, True]  # the same, worse, and another click


def test_a_rejected_result_waits_for_its_correction_which_reaches_nothing_else(store):
    waiting = {unit.unit: unit.request for unit in run(store, "auto").waiting}
    wrong = waiting.pop(WRONG)
    approve(store, *waiting.values())
    opened = open_match(store, TINY)
    before = {unit.name: unit.key for unit in plan_run(store, opened, {})}
    files = sorted(opened.folder.folder.rglob("*.json"))
    contents = [file.read_bytes() for file in files]
    edit = wrong_click(opened)
    approve(store, wrong, verdict="reject", edits=[edit])
    match, latest = open_match(store, TINY), latest_run(store, TINY)
    assert [file.read_bytes() for file in files] == contents
    after = {unit.name: unit for unit in plan_run(store, match, {})}
    changed = {name for name, unit in after.items() if unit.key != before[name]}
    early = {name for name in changed if name.startswith(("ingest/", "static_calibration/"))}
    assert early == {WRONG}
    (clicked,) = after[WRONG].recipe.sources["clicked"].values()
    assert edit.marking not in clicked["points"]
    origins = origins_of(store, match, latest)
    assert (origins[WRONG], origins["static_calibration/cam00"]) == ("rejected", "automatic")
    # No policy uses a rejected result.
    held = Gatekeeper(store, match, "never").list_held_units("static_calibration", latest.results)
    assert units(held) == [WRONG]
    # After the withdrawal the state is the former one; the rejection stands until an approval.
    withdraw(store, match, [match.corrections[0].id], who="Bob", why="it was right")
    again = open_match(store, TINY)
    assert {unit.name: unit.key for unit in plan_run(store, again, {})} == before
    record = run(store, "auto")
    assert [(unit.unit, unit.rejected) for unit in record.waiting] == [(WRONG, True)]
    assert record.waiting[0].reasons == ("Ada rejected it: looked",)
    with pytest.raises(InputError, match="nothing that waits"):
        approve(store)
    approve(store, wrong)
    assert run(store, "auto").state == "complete"


def test_people_are_asked_and_answer_on_the_command_line(tiny, store, tmp_path):
    at = ("--project", store.url)
    answer = worldpose("run", tiny, "--gates", "auto", *at)
    assert answer.code == 3
    assert "2 reviews pending:" in answer.out
    assert "next: worldpose review serve, to decide; then worldpose run" in answer.out

    def say(*arguments):
        """Return the output of a command, run in this process to save seconds."""
        return invoke(*arguments, *at)

    reviews = json.loads(say("review", "list", "--json").stdout)["reviews"]
    assert {(each["state"], each["match_id"]) for each in reviews} == {("waits", TINY)}
    status = json.loads(say("status", "--json").stdout)["matches"][0]
    assert (status["state"], len(status["waiting"])) == ("waiting", 2)
    wrong = next(each["id"] for each in reviews if WRONG in each["keys"])
    shown = say("review", "show", TINY, wrong).stdout
    assert "clicks that contradict the others: 1, limit 0" in shown
    assert say("review", "approve", TINY).exit_code == 2  # who
    edits = tmp_path / "edits.json"
    edits.write_text('[{"kind": "moved_point", "camera": "cam03", "marking": "corner", "xy": []}]')
    rejection = ("review", "reject", TINY, "--who", "Ada", "--why", "x", "--edits", edits)
    assert "edits.json: 0.moved_point.xy" in str(say(*rejection).exception)
    done = json.loads(say("review", "approve", TINY, "--who", "Ada", "--json").stdout)
    assert set(done["reviews"]) == {each["id"] for each in reviews}
    # The latest run waits: the next one continues with its policy.
    again = json.loads(say("run", tiny, "--json").stdout)
    assert (again["waiting"], again["executed"], again["gates"]) == (0, 0, "auto")
    assert "nothing waits" in say("review", "list").stdout
