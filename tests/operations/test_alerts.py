"""Somebody is told of each matter once: a real server takes what is posted."""

from datetime import UTC, datetime, timedelta

import pytest

from data_contracts.operations import Arrival
from flows.operations.alerts import Alert, FailedRun, Teller, alerts_now
from flows.operations.layout import StateFolder
from flows.operations.overview import MatchGlance, UnitGlance
from flows.operations.plan import ServePlan
from flows.operations.senders import Webhook

NOW = datetime.now(UTC)


@pytest.fixture
def plan(tmp_path):
    return ServePlan(
        project=str(tmp_path),
        inbox=tmp_path,
        state=tmp_path,
        prefect="http://127.0.0.1:4200/api",
        gate_hours=1.0,
        disk_gb=0.0,
    )


def kinds(alerts):
    return [alert.alert for alert in alerts]


def test_each_matter_is_posted_once_as_json_with_text(webhook, tmp_path):
    teller = Teller(StateFolder(tmp_path), [Webhook(webhook.address)])
    alert = Alert("disk_low", "disk_low", "3.0 GB are free", "http://127.0.0.1:8571/status")
    assert teller.tell([alert]) == [alert]
    assert teller.tell([alert]) == []
    (posted,) = webhook.posted
    assert posted == (
        "application/json",
        {"alert": "disk_low", "match": "", "text": "3.0 GB are free", "link": alert.link},
    )
    # A restart repeats nothing; what was over and is again is a new matter.
    again = Teller(StateFolder(tmp_path), [Webhook(webhook.address)])
    assert again.tell([alert]) == []
    assert again.tell([]) == []
    assert again.tell([alert]) == [alert]
    assert "secret" not in (tmp_path / "alerts.json").read_text()


def test_what_the_webhook_did_not_take_is_posted_again(webhook, tmp_path, caplog):
    alert = Alert("disk_low", "disk_low", "little")
    webhook.codes += [500]
    teller = Teller(StateFolder(tmp_path), [Webhook(webhook.address)])
    assert teller.tell([alert]) == []
    assert Teller(StateFolder(tmp_path), [Webhook("http://127.0.0.1:9/secret")]).tell([alert]) == []
    assert Teller(StateFolder(tmp_path), [Webhook("no address")]).tell([alert]) == []
    assert Teller(StateFolder(tmp_path), [Webhook(webhook.address)]).tell([alert]) == [alert]
    assert len(webhook.posted) == 2
    assert "secret" not in caplog.text


def test_a_question_is_no_alert_before_its_time(plan):
    def waiting(hours):
        since = datetime.now(UTC) - timedelta(hours=hours)
        unit = UnitGlance("cam04", "waiting", waiting_since=since, why="clicks_wrong is 1")
        return [MatchGlance("m", stages={"static_calibration": (unit,)})]

    assert alerts_now(plan, waiting(0.9), [], []) == []
    (alert,) = alerts_now(plan, waiting(1.1), [], [])
    assert (alert.alert, alert.match_id) == ("gate_waiting", "m")
    assert alert.link == "http://127.0.0.1:8571/#/match/m"
    assert "m/static_calibration/cam04 has waited for a person for 1.1 h" in alert.text
    assert alerts_now(plan, waiting(1.2), [], [])[0].key == alert.key


def test_quality_refusals_failed_runs_and_a_full_disk_are_alerts(plan):
    unit = UnitGlance("clip", "done", objections=("offset_rms_m is 0.05, at most 0.03 passes",))
    match = MatchGlance("m", stages={"body_fitting": (unit,)})
    assert kinds(alerts_now(plan, [match], [], [])) == ["quality"]
    arrivals = [
        Arrival(name=state, state=state, reason="it is a link", changed_at=NOW)
        for state in ("arriving", "incomplete", "refused", "taken")
    ]
    (refused,) = alerts_now(plan, [], arrivals, [])
    assert "refused in the inbox is refused: it is a link" in refused.text
    (failed,) = alerts_now(plan, [], [], [FailedRun("1f2e", "m", "crashed", "killed")])
    assert failed.link == "http://127.0.0.1:4200/runs/flow-run/1f2e"
    full = plan.model_copy(update={"disk_gb": 1e9})
    assert kinds(alerts_now(full, [], [], [])) == ["disk_low"]


def test_a_good_match_raises_nothing(plan):
    unit = UnitGlance("clip", "done", 1.0, {"offset_rms_m": 0.01})
    assert alerts_now(plan, [MatchGlance("m", stages={"body_fitting": (unit,)})], [], []) == []
