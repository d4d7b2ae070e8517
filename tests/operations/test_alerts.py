"""Each alert is sent once to every channel, to real servers."""

import logging
import os
import socketserver
from datetime import UTC, datetime, timedelta
from email import message_from_bytes
from functools import partial
from threading import Event, Thread
from types import SimpleNamespace

import apprise
import pytest
import service
from command_line import worldpose
from run_records import run_record

from data_contracts.operations import Arrival, MatchSummary, Question, QueuedRun
from data_contracts.usability import Usability
from flows.service import watching
from flows.service.alerts import (
    LONGEST_PAUSE,
    MAX_SINGLE,
    Alert,
    AlertDispatcher,
    alerts_now,
    kept_alerts,
)
from flows.service.channels import Channel, apprise_mail, channels_of
from flows.service.layout import StateFolder
from flows.service.plan import ServePlan
from flows.service.watching import Trouble
from worldpose.errors import UsageError
from worldpose.store.store import Store

wait_until = partial(service.wait_until, pause=0.05)

NOW = datetime.now(UTC)
ABSENT = Channel("absent", "http://127.0.0.1:9/secret")


def hook(webhook):
    return Channel("webhook", webhook.address)


def tell(folder, channel, *alerts):
    """Hold alerts and deliver them once, as after a restart; return the pause that follows [s]."""
    folder.mkdir(exist_ok=True)
    dispatcher = AlertDispatcher(StateFolder(folder), [channel])
    dispatcher.hold(alerts)
    return dispatcher.deliver(channel)


def many(count):
    return [Alert(str(number), "quality", f"alert {number}") for number in range(count)]


def test_each_matter_is_posted_once_as_json_with_text(webhook, tmp_path):
    alert = Alert("disk_low", "disk_low", "3.0 GB are free", "http://127.0.0.1:8571/status")
    for _ in range(2):  # a restart repeats nothing
        assert tell(tmp_path, hook(webhook), alert) == 0.0
    content = {"alert": "disk_low", "match": "", "text": "3.0 GB are free", "link": alert.link}
    assert webhook.posted == [("application/json", content)]
    assert "secret" not in (tmp_path / "alerts.json").read_text()
    tell(tmp_path, hook(webhook))  # what was over and is again is a new matter
    tell(tmp_path, hook(webhook), alert)
    assert len(webhook.posted) == 2
    (tmp_path / "alerts.json").write_text('{"disk_low": ')
    tell(tmp_path, hook(webhook), alert)
    assert len(webhook.posted) == 3


def test_a_failed_channel_is_tried_again_later_and_keeps_no_other_waiting(
    webhook, tmp_path, caplog
):
    dispatcher = AlertDispatcher(StateFolder(tmp_path), [ABSENT, hook(webhook)])
    dispatcher.hold(many(5))
    pauses = [0.0]
    for _ in range(10):
        pauses.append(dispatcher.deliver(ABSENT, pauses[-1]))
    assert (pauses[1:4], pauses[-1]) == ([30.0, 60.0, 120.0], LONGEST_PAUSE)
    webhook.codes += [204, 500]
    pause = dispatcher.deliver(dispatcher.channels[1])
    assert (pause, len(webhook.posted)) == (30.0, 2)  # it stops at the first failure
    assert dispatcher.deliver(dispatcher.channels[1], pause) == 0.0
    posted = [each["text"] for _, each in webhook.posted]
    assert posted == [f"alert {number}" for number in (0, 1, 1, 2, 3, 4)]
    assert "webhook takes alerts again" in caplog.text
    assert "secret" not in caplog.text
    webhook.codes += [302, 307]  # a redirect is a failure and is not followed
    for _ in range(2):
        assert tell(tmp_path / "redirected", hook(webhook), *many(1)) == 30.0


class Conversation(socketserver.StreamRequestHandler):
    """A mail server's side of one session, as RFC 5321 has it."""

    def handle(self):
        self.say("220 test")
        while line := self.rfile.readline():
            verb, _, rest = line.decode().strip().partition(" ")
            if verb.upper() == "RCPT":
                self.server.receivers.append(rest[4:-1])
            if verb.upper() == "DATA":
                self.say("354 start mail input")
                lines = b"".join(iter(self.rfile.readline, b".\r\n"))
                self.server.letters.append(message_from_bytes(lines))
            self.say("221 bye" if verb.upper() == "QUIT" else "250 ok")

    def say(self, text):
        self.wfile.write(f"{text}\r\n".encode())


@pytest.fixture
def mail_server():
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Conversation) as server:
        server.letters, server.receivers = [], []
        Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server
        server.shutdown()


FILE = """
webhook = "{webhook}"
channels = ["json://127.0.0.1:9/other"]

[mail]
server = "smtp://127.0.0.1:{port}"
sender = "worldpose@example.org"
receivers = ["ada@example.org", "bob@example.org"]
"""


def write_settings(project, text, mode=0o600):
    file = StateFolder(project / "operations").alert_settings
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    file.chmod(mode)
    return file


def test_channels_of_a_file_get_a_test_alert_by_a_command(mail_server, webhook, tmp_path):
    text = FILE.format(webhook=webhook.address, port=mail_server.server_address[1])
    file = write_settings(tmp_path, text)
    command = ("serve", "--test-alerts", "--project", tmp_path)
    answer = worldpose(*command)
    accepted, failed, mailed = answer.out.splitlines()
    assert (accepted, mailed) == ("webhook: accepted a test alert", "mail: accepted a test alert")
    assert answer.code == 1 and failed.startswith("json: failed: A Connection error")
    ((_, posted),) = webhook.posted
    assert posted["alert"] == "test" and "arrive here" in posted["text"]
    letter, _ = mail_server.letters
    assert set(mail_server.receivers) == {"ada@example.org", "bob@example.org"}
    assert "worldpose@example.org" in letter["From"]
    assert letter["Subject"] == "worldpose: test"
    assert "arrive here" in letter.get_payload(decode=True).decode()
    # The environment comes first; a channel that fails is named, without its address.
    webhook.codes = [403]
    answer = worldpose(*command, "--json", environment={"WORLDPOSE_ALERT_URL": webhook.address})
    problems = {"webhook": "it answered 403", "mail": ""}
    assert (answer.code, answer.json["channels"]) == (1, problems)
    assert "secret" not in answer.out + answer.err
    file.unlink()
    answer = worldpose(*command)
    assert answer.code == 2 and "found none" in answer.err


def test_a_letter_has_the_run_in_its_subject_on_one_line(mail_server, tmp_path):
    port = mail_server.server_address[1]
    mail = Channel("mail", apprise_mail(f"smtp://127.0.0.1:{port}/?to=ann@example.org"))
    lines = "run m failed: it\nhas two lines"
    assert tell(tmp_path, mail, Alert("1", "run_failed", lines, "http://here/run", "m")) == 0.0
    (letter,) = mail_server.letters
    assert letter["Subject"] == "worldpose: run failed, m"  # an error's lines become no headers
    body = letter.get_payload(decode=True).decode()
    assert body.split() == [*lines.split(), "http://here/run"]


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("smtps://ann:a%40b@mail.org/?to=a@b.org", ("mail.org", 465, "ssl", "ann", "a@b")),
        ("smtp://ann:p@mail.org/?to=a@b.org", ("mail.org", 25, "starttls", "ann", "p")),
        ("smtp://mail.org:2525/?to=a@b.org", ("mail.org", 2525, "insecure", None, None)),
    ],
)
def test_a_password_goes_under_tls_alone(address, expected):
    mail = apprise.Apprise.instantiate(apprise_mail(address))
    assert (mail.smtp_host, mail.port, mail.secure_mode, mail.user, mail.password) == expected
    assert mail.verify_certificate


def test_channels_are_named_by_the_environment_and_a_bad_one_says_no_secret(tmp_path):
    assert channels_of({}, tmp_path / "absent") == ()
    slack = "slack://T1JJ3T3L2/A1BRTD4JD/TIiajkdnlazkcOXrIdevi7FQ"
    found = channels_of(
        {
            "WORLDPOSE_ALERT_URL": f"http://hook/ {slack} {slack}/#two",
            "WORLDPOSE_ALERT_MAIL": "smtps://a:b@mail.example.org/?to=c@example.org",
        }
    )
    assert [each.name for each in found] == ["webhook", "slack", "slack 2", "mail"]
    bad = ("mail.example.org", "smtp://ann:secret@mail/", "http://secret/?to=a", "smtp://x:y/")
    addresses = ("file:///secret", "ftp://h/x", "//h/x", "http://", "http://h:99999/", "h/secret")
    for variable, values in (("WORLDPOSE_ALERT_MAIL", bad), ("WORLDPOSE_ALERT_URL", addresses)):
        for value in values:
            with pytest.raises(UsageError, match=variable) as refused:
                channels_of({variable: value})
            assert value not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "mode", "problem"),
    [
        ("webhook = 'http://h/'", 0o644, "mode 644"),
        ("webhook = http://secret/", 0o600, "may hold a secret"),
        ("hook = 'http://secret/'", 0o600, "hook"),
        ("channels = ['secret://x']", 0o600, "may hold a secret"),
        ("[mail]\nserver = 'smtp://h'\nreceivers = []", 0o600, "mail.receivers"),
        ("[mail]\nserver = 'secret'\nreceivers = ['a@b']", 0o600, "may hold a secret"),
    ],
)
def test_a_bad_file_is_refused_without_its_secrets(text, mode, problem, tmp_path):
    file = write_settings(tmp_path, text, mode)
    with pytest.raises(UsageError, match=problem) as refused:
        channels_of({}, file)
    assert "http://secret" not in str(refused.value)


def test_a_trouble_that_lasts_is_one_line_and_its_end_another(caplog):
    trouble = Trouble("looking at the inbox")
    for _ in range(100):
        with trouble.log_failure():
            raise OSError(28, os.strerror(28))
    with trouble.log_failure():
        pass
    assert [record.message for record in caplog.records] == [
        "looking at the inbox failed: OSError: [Errno 28] No space left on device; "
        "it is tried again",
        "looking at the inbox works again",
    ]


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


def test_a_question_is_no_alert_before_its_time(plan):
    now = datetime.now(UTC)  # not that of the import: the suite takes minutes

    def waiting(*hours, run="0001"):
        unit = "static_calibration/cam04"
        asked = [
            Question(
                id="q", unit=unit, since=now - timedelta(hours=it), reasons=("clicks_wrong is 1",)
            )
            for it in hours
        ]
        latest = run_record(state="waiting", run_id=run)
        return [MatchSummary(match_id="m", waiting=tuple(asked), latest=latest)]

    assert alerts_now(plan, waiting(0.9), [], []) == []
    (alert,) = alerts_now(plan, waiting(1.1), [], [])
    assert (alert.alert, alert.match_id) == ("gate_waiting", "m")
    assert alert.link == "http://127.0.0.1:8571/#/match/m"
    assert "m/static_calibration/cam04 has waited for a person for 1.1 h" in alert.text
    # A run of a part keeps the question; another question is another alert.
    assert alerts_now(plan, waiting(1.1, run="0002"), [], [])[0].key == alert.key
    assert alerts_now(plan, waiting(2.1, 1.1), [], [])[0].key == alert.key
    assert alerts_now(plan, waiting(1.2), [], [])[0].key != alert.key


def test_quality_refusals_failed_runs_and_a_full_disk_are_alerts(plan):
    def judged(state, *reservations):
        verdict = "usable with reservations" if reservations else "usable"
        usability = Usability(verdict=verdict, reservations=reservations)
        latest = run_record(state=state, usability=usability)
        return MatchSummary(match_id="m", latest=latest)

    assert alerts_now(plan, [judged("complete")], [], []) == []
    assert alerts_now(plan, [judged("waiting", "cam1 is bad.")], [], []) == []  # it asks already
    (poor,) = alerts_now(plan, [judged("complete", "cam1 is bad.", "cam2 is.")], [], [])
    text = "m is usable with reservations: cam1 is bad. cam2 is."
    assert (poor.alert, poor.text) == ("quality", text)
    arrivals = [
        Arrival(name=state, state=state, reason="it is a link", changed_at=NOW)
        for state in ("arriving", "incomplete", "refused", "taken")
    ]
    (refused,) = alerts_now(plan, [], arrivals, [])
    assert "refused in the inbox is refused: it is a link" in refused.text
    (failed,) = alerts_now(plan, [], [], [ended("m", "failed", "killed")])
    assert failed.link == "http://127.0.0.1:4200/runs/flow-run/1f2e"
    (full,) = alerts_now(plan.model_copy(update={"disk_gb": 1e9}), [], [], [])
    assert full.alert == "disk_low"


def ended(match, state, message="", number=1, **more):
    return QueuedRun(
        id=f"run-{number}",
        flow="match",
        name=f"{match}, {number}",
        match_id=match,
        flow_run="1f2e",
        state=state,
        message=message,
        asked_at=NOW + timedelta(minutes=number),
        changed_at=NOW,
        **more,
    )


def test_a_later_run_that_ended_well_ends_the_alert_and_old_failures_raise_none(plan):
    first = ended("m", "failed", "dark")
    assert len(alerts_now(plan, [], [], [first])) == 1
    assert len(alerts_now(plan, [], [], [first, ended("m", "begun", number=2)])) == 1
    assert alerts_now(plan, [], [], [first, ended("m", "complete", number=2)]) == []
    for minutes, count in ((1, 0), (-60, 1)):  # of a run from a shell
        done = run_record(finished_at=NOW + timedelta(minutes=minutes))
        assert (
            len(alerts_now(plan, [MatchSummary(match_id="m", latest=done)], [], [first])) == count
        )
    old = first.model_copy(update={"changed_at": NOW - timedelta(days=8)})
    assert alerts_now(plan, [], [], [old]) == []


def test_a_run_that_was_ended_for_lack_of_progress_is_an_alert_until_it_ends(plan):
    run = ended("m", "asked", stalled="no progress for 10 min", kills=1)
    (alert,) = alerts_now(plan, [], [], [run])
    assert (alert.alert, "no progress for 10 min" in alert.text) == ("run_stalled", True)
    done = run.model_copy(update={"state": "complete"})
    assert alerts_now(plan, [], [], [done]) == []


def test_a_match_is_one_message_and_each_new_cause_another(plan, webhook, tmp_path):
    since = datetime.now(UTC) - timedelta(hours=2)
    usability = Usability(verdict="usable with reservations", reservations=("cam1 is bad.",))
    latest = run_record(state="partial", usability=usability)
    waits = [
        Question(id=f"q{it}", unit=f"static_calibration/d{it}", since=since) for it in range(6)
    ]
    match = MatchSummary(match_id="m", latest=latest, waiting=tuple(waits))
    runs = [ended("m", "failed", "dark")]
    assert tell(tmp_path / "a", hook(webhook), *alerts_now(plan, [match], [], runs)) == 0.0
    ((_, sent),) = webhook.posted
    assert (sent["alert"], sent["match"]) == ("run_failed", "m")
    assert "and 5 more results" in sent["text"] and sent["text"].endswith("cam1 is bad.")
    # A match whose failure is known begins to wait.
    tell(tmp_path / "b", hook(webhook), *alerts_now(plan, [MatchSummary(match_id="m")], [], runs))
    tell(tmp_path / "b", hook(webhook), *alerts_now(plan, [match], [], runs))
    first, second = (sent for _, sent in webhook.posted[1:])
    assert (first["alert"], second["alert"]) == ("run_failed", "gate_waiting")
    assert "dark" not in second["text"] and "has waited" in second["text"]


def test_an_alert_is_sent_though_the_disk_of_the_log_does_not_answer(webhook, tmp_path):
    answers, log = Event(), logging.Handler()
    log.emit = lambda record: answers.wait(60.0)
    watching.LOG.addHandler(log)
    try:
        dispatcher = AlertDispatcher(StateFolder(tmp_path), [hook(webhook)])
        holding = Thread(target=dispatcher.hold, args=[many(1)])
        holding.start()
        wait_until(lambda: dispatcher.deliver(dispatcher.channels[0]) == 0.0 and webhook.posted)
        assert not answers.is_set()
    finally:
        answers.set()
        holding.join()
        watching.LOG.removeHandler(log)


def test_a_flood_of_alerts_is_one_message(webhook, tmp_path):
    dispatcher = AlertDispatcher(StateFolder(tmp_path), [hook(webhook)])
    dispatcher.hold(many(2000))
    dispatcher.deliver(dispatcher.channels[0])
    ((_, posted),) = webhook.posted
    assert posted["alert"] == "digest" and posted["text"].startswith("2000 alerts are new:")
    assert "1990 more" in posted["text"]
    dispatcher.hold(many(2000))
    dispatcher.deliver(dispatcher.channels[0])
    assert len(webhook.posted) == 1


def test_alerts_that_last_are_told_once_a_day(webhook, tmp_path):
    dispatcher = AlertDispatcher(StateFolder(tmp_path), [hook(webhook)])
    dispatcher.hold(many(2))
    dispatcher.deliver(dispatcher.channels[0])
    assert len(webhook.posted) == 2  # of their first day there is no digest
    text = StateFolder(tmp_path).alerts.read_text()
    StateFolder(tmp_path).alerts.write_text(text.replace(f"{NOW:%Y-%m-%d}", "2026-01-01"))
    for _ in range(2):  # also after a restart
        dispatcher = AlertDispatcher(StateFolder(tmp_path), [hook(webhook)])
        dispatcher.hold(many(3))
        dispatcher.deliver(dispatcher.channels[0])
    assert [each["alert"] for _, each in webhook.posted] == [*["quality"] * 3, "digest"]
    assert webhook.posted[-1][1]["text"].splitlines() == ["2 alerts last:", "alert 0", "alert 1"]


def test_alerts_of_two_sources_do_not_end_each_other(tmp_path):
    dispatcher = AlertDispatcher(StateFolder(tmp_path), [])
    dispatcher.hold(many(1))
    dispatcher.hold([Alert("steps", "watch_stalled", "a disk")], source="steps")
    assert set(kept_alerts(StateFolder(tmp_path))) == {"0", "steps"}
    again = AlertDispatcher(StateFolder(tmp_path), [])  # after a restart the other one looks first
    again.hold([], source="steps")
    assert "0" in kept_alerts(StateFolder(tmp_path))
    dispatcher.hold([], source="steps")
    assert set(kept_alerts(StateFolder(tmp_path))) == {"0"}
    assert MAX_SINGLE > 5


def test_alerts_are_sent_though_some_matches_are_never_read(plan, tmp_path, monkeypatch):
    match = MatchSummary(match_id="m", is_unseen=True)
    Store.create(plan.project)
    state = StateFolder(tmp_path)
    former = Alert("quality/m/weak", "quality", "m is weak", match_id="m")
    over = Alert("quality/n/weak", "quality", "n is weak", match_id="n")
    AlertDispatcher(state, []).hold([former, over])
    monkeypatch.setattr(watching, "READING_SECONDS", 0.0)
    looks = SimpleNamespace(look=lambda budget: [match])
    stalled = Alert("run_stalled/1", "run_stalled", "a run makes no progress")
    dispatcher = AlertDispatcher(state, [])
    watching._hold_alerts(plan, looks, dispatcher, SimpleNamespace(alerts=[stalled]))()
    # Nothing says that the alert of the unread match is over.
    assert set(kept_alerts(state)) == {"quality/m/weak", "run_stalled/1"}
