"""Each alert is sent once, to a real server."""

import socket
from datetime import UTC, datetime, timedelta
from threading import Thread
from types import SimpleNamespace

import pytest

from data_contracts.operations import Arrival
from flows.service.alerts import Alert, AlertDispatcher, FailedRun, alerts_now
from flows.service.layout import StateFolder
from flows.service.overview import MatchStatus, UnitSummary
from flows.service.plan import ServePlan
from flows.service.senders import Webhook, senders_of
from flows.service.watching import Trouble
from worldpose.errors import UsageError

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
    teller = AlertDispatcher(StateFolder(tmp_path), [Webhook(webhook.address)])
    alert = Alert("disk_low", "disk_low", "3.0 GB are free", "http://127.0.0.1:8571/status")
    assert teller.tell([alert]) == [alert]
    assert teller.tell([alert]) == []
    (posted,) = webhook.posted
    assert posted == (
        "application/json",
        {"alert": "disk_low", "match": "", "text": "3.0 GB are free", "link": alert.link},
    )
    # A restart repeats nothing; what was over and is again is a new matter.
    again = AlertDispatcher(StateFolder(tmp_path), [Webhook(webhook.address)])
    assert again.tell([alert]) == []
    assert again.tell([]) == []
    assert again.tell([alert]) == [alert]
    assert "secret" not in (tmp_path / "alerts.json").read_text()


def test_what_the_webhook_did_not_take_is_posted_again(webhook, tmp_path, caplog):
    alert = Alert("disk_low", "disk_low", "little")
    webhook.codes += [500]
    teller = AlertDispatcher(StateFolder(tmp_path), [Webhook(webhook.address)])
    assert teller.tell([alert]) == []
    assert (
        AlertDispatcher(StateFolder(tmp_path), [Webhook("http://127.0.0.1:9/secret")]).tell([alert])
        == []
    )
    assert AlertDispatcher(StateFolder(tmp_path), [Webhook("no address")]).tell([alert]) == []
    assert (
        AlertDispatcher(StateFolder(tmp_path), [Webhook("file:///etc/passwd")]).tell([alert]) == []
    )
    assert AlertDispatcher(StateFolder(tmp_path), [Webhook(webhook.address)]).tell([alert]) == [
        alert
    ]
    assert len(webhook.posted) == 2
    assert "secret" not in caplog.text


@pytest.fixture
def silent():
    """The address of a server that accepts connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}/secret"


def many(count):
    return [Alert(str(number), "quality", f"alert {number}") for number in range(count)]


def test_a_silent_webhook_is_asked_once_and_then_left_for_a_while(
    silent, tmp_path, caplog, monkeypatch
):
    """Sixty alerts were sixty times ten seconds, and a line of the log each, for ever."""
    monkeypatch.setattr("flows.service.senders.ANSWER_SECONDS", 0.05)
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr("flows.service.alerts.time", SimpleNamespace(monotonic=lambda: clock.now))
    teller = AlertDispatcher(StateFolder(tmp_path), [Webhook(silent)])
    for _ in range(2880):  # a day of looks
        clock.now += 30.0
        teller.tell(many(60))
    told = [record.message for record in caplog.records if "did not take" in record.message]
    assert 20 < len(told) < 35, "the pause doubles up to an hour"
    assert "59 more" in told[0]
    assert "secret" not in caplog.text


def test_a_silent_webhook_keeps_no_mail_from_being_sent(silent, tmp_path):
    class Box:
        name, taken = "mail", []

        def send(self, content):
            self.taken.append(content["text"])

    box, hook = Box(), Webhook(silent)
    teller = AlertDispatcher(StateFolder(tmp_path), [hook, box])
    teller.hold(many(60))
    waiting = Thread(target=teller.deliver, args=[hook], daemon=True)
    waiting.start()
    teller.deliver(box)
    assert len(box.taken) == 60
    assert waiting.is_alive(), "the webhook is still waited for"
    teller.hold([])  # nor does that keep others from saying what holds


def test_delivery_stops_at_the_first_failure_and_goes_on_after_it(webhook, tmp_path, caplog):
    teller = AlertDispatcher(StateFolder(tmp_path), [Webhook(webhook.address)], pause=0.0)
    webhook.codes += [204, 500]
    assert [each.key for each in teller.tell(many(5))] == ["0"]
    assert len(webhook.posted) == 2
    assert [each.key for each in teller.tell(many(5))] == ["1", "2", "3", "4"]
    assert [posted["text"] for _, posted in webhook.posted][2:] == [
        f"alert {number}" for number in (1, 2, 3, 4)
    ]
    assert "takes alerts again" in caplog.text


def test_a_redirect_is_a_failure_and_is_not_followed(webhook, tmp_path):
    webhook.codes += [302, 307]
    teller = AlertDispatcher(StateFolder(tmp_path), [Webhook(webhook.address)], pause=0.0)
    assert teller.tell(many(1)) == []
    assert teller.tell(many(1)) == []
    assert len(webhook.posted) == 2


@pytest.mark.parametrize(
    "address",
    ["file:///etc/passwd", "ftp://h/x", "//h/x", "http://", "http://h:99999/", "h/secret"],
)
def test_an_address_that_is_no_web_address_is_refused_at_start(address):
    with pytest.raises(UsageError, match="WORLDPOSE_ALERT_URL") as caught:
        senders_of({"WORLDPOSE_ALERT_URL": address})
    assert "secret," not in str(caught.value).replace("hold a secret", "")
    assert address not in str(caught.value)


def test_damaged_notes_of_what_was_told_are_begun_anew(webhook, tmp_path):
    (tmp_path / "alerts.json").write_text('{"disk_low": ')
    teller = AlertDispatcher(StateFolder(tmp_path), [Webhook(webhook.address)])
    assert len(teller.tell(many(1))) == 1


def test_a_trouble_that_lasts_is_one_line_and_its_end_another(caplog):
    trouble = Trouble("looking at the inbox")
    for _ in range(100):
        with trouble.log_failure():
            raise OSError(28, "No space left on device")
    with trouble.log_failure():
        pass
    assert [record.message for record in caplog.records] == [
        "looking at the inbox failed: OSError: [Errno 28] No space left on device; "
        "it is tried again",
        "looking at the inbox works again",
    ]


def test_a_question_is_no_alert_before_its_time(plan):
    def waiting(hours):
        since = datetime.now(UTC) - timedelta(hours=hours)
        unit = UnitSummary("cam04", "waiting", waiting_since=since, why="clicks_wrong is 1")
        return [MatchStatus("m", stages={"static_calibration": (unit,)})]

    assert alerts_now(plan, waiting(0.9), [], []) == []
    (alert,) = alerts_now(plan, waiting(1.1), [], [])
    assert (alert.alert, alert.match_id) == ("gate_waiting", "m")
    assert alert.link == "http://127.0.0.1:8571/#/match/m"
    assert "m/static_calibration/cam04 has waited for a person for 1.1 h" in alert.text
    assert alerts_now(plan, waiting(1.2), [], [])[0].key == alert.key


def test_quality_refusals_failed_runs_and_a_full_disk_are_alerts(plan):
    unit = UnitSummary("clip", "done", objections=("offset_rms_m is 0.05, at most 0.03 passes",))
    match = MatchStatus("m", stages={"body_fitting": (unit,)})
    (poor,) = alerts_now(plan, [match], [], [])
    assert poor.alert == "quality"
    assert poor.text == "m/body_fitting/clip: offset rms: 0.05 m, limit 0.03 m"
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
    unit = UnitSummary("clip", "done", 1.0, {"offset_rms_m": 0.01})
    assert alerts_now(plan, [MatchStatus("m", stages={"body_fitting": (unit,)})], [], []) == []
