"""Alerts by mail: a real SMTP server takes them, with and without TLS."""

import base64
import socketserver
import ssl
import subprocess
from email import message_from_bytes
from threading import Thread

import pytest
from command_line import succeed, worldpose

from flows.service.alerts import Alert, AlertDispatcher
from flows.service.layout import StateFolder
from flows.service.senders import Mail, Webhook, senders_of
from worldpose.errors import UsageError

ALERT = Alert(
    "run_failed/1", "run_failed", "run m failed: it\nhas two lines", "http://here/run", "m"
)


class Conversation(socketserver.StreamRequestHandler):
    """One client's session as RFC 5321 has it, with PLAIN log-in and the STARTTLS of RFC 3207."""

    def setup(self):
        if self.server.tls is not None and not self.server.is_asked_for_tls:
            self.request = self.server.tls.wrap_socket(self.request, server_side=True)
        super().setup()

    def handle(self):
        self.say("220 test")
        letter = {"to": []}
        while line := self.rfile.readline():
            verb, _, rest = line.decode().strip().partition(" ")
            verb = verb.upper()
            self.server.verbs.append(verb)
            if verb == "EHLO":
                is_bare = not isinstance(self.request, ssl.SSLSocket)
                offered = "250-STARTTLS\r\n" * (is_bare and self.server.is_asked_for_tls)
                self.say(f"250-test\r\n{offered}250 AUTH PLAIN")
            elif verb == "STARTTLS":
                self.say("220 ready to start TLS")
                self.request = self.server.tls.wrap_socket(self.request, server_side=True)
                super().setup()
            elif verb == "AUTH":
                _, user, password = base64.b64decode(rest.split()[1]).decode().split("\0")
                self.server.logins.append((user, password))
                self.say("235 yes")
            elif verb == "MAIL":
                letter["from"] = rest[6:-1].partition(">")[0]
                self.say("250 ok")
            elif verb == "RCPT":
                letter["to"].append(rest[4:-1])
                self.say(self.server.answers.pop(0) if self.server.answers else "250 ok")
            elif verb == "DATA":
                self.say("354 start mail input")
                lines = iter(self.rfile.readline, b".\r\n")
                letter["message"] = message_from_bytes(b"".join(lines))
                self.server.letters.append(letter)
                self.say("250 ok")
            elif verb == "QUIT":
                self.say("221 bye")
                return
            else:
                self.say("250 ok")

    def say(self, text):
        self.wfile.write(f"{text}\r\n".encode())


@pytest.fixture
def post_office():
    """A function that begins a mail server, which keeps letters and log-ins."""
    servers = []

    def begin(tls=None, is_asked_for_tls=False):
        server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Conversation)
        server.tls, server.is_asked_for_tls = tls, is_asked_for_tls
        server.letters, server.logins, server.answers, server.verbs = [], [], [], []
        server.port = server.server_address[1]
        Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        servers.append(server)
        return server

    yield begin
    for server in servers:
        server.shutdown()
        server.server_close()


def test_an_alert_is_a_letter_to_all_who_are_named(post_office, tmp_path):
    server = post_office()
    mail = Mail.at(f"smtp://127.0.0.1:{server.port}/?to=ann@example.org&to=bo@example.org")
    assert AlertDispatcher(StateFolder(tmp_path), [mail]).tell([ALERT, ALERT]) == [ALERT]
    assert AlertDispatcher(StateFolder(tmp_path), [mail]).tell([ALERT]) == []
    (letter,) = server.letters
    assert letter["to"] == ["ann@example.org", "bo@example.org"]
    assert letter["from"] == "ann@example.org"
    message = letter["message"]
    # An error's lines must not become headers.
    assert message["Subject"] == "worldpose: run m failed: it has two lines"
    assert message.get_payload() == "run m failed: it\r\nhas two lines\r\n\r\nhttp://here/run\r\n"


@pytest.fixture
def localhost_tls(tmp_path):
    """A server's TLS as `localhost`, and the file of its self-signed certificate."""
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
    make = ["openssl", "req", "-x509", *curve, "-nodes", "-days", "2"]
    named = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    files = ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*make, *named, *files], check=True, capture_output=True)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate, key)
    return tls, certificate


def test_a_password_goes_under_tls_alone(post_office, localhost_tls, tmp_path, monkeypatch, caplog):
    tls, certificate = localhost_tls
    secure, plain = post_office(tls), post_office()
    who = "ann:a%40secret@localhost"
    mail = Mail.at(f"smtps://{who}:{secure.port}/?to=ann@example.org&from=worldpose@example.org")
    teller = AlertDispatcher(StateFolder(tmp_path / "one"), [mail], pause=0.0)
    assert teller.tell([ALERT]) == []
    assert secure.logins == [], "an untrusted certificate was accepted"
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    assert teller.tell([ALERT]) == [ALERT]
    assert secure.logins == [("ann", "a@secret")]
    assert secure.letters[0]["from"] == "worldpose@example.org"
    bare = Mail.at(f"smtp://{who}:{plain.port}/?to=ann@example.org")
    assert AlertDispatcher(StateFolder(tmp_path / "two"), [bare]).tell([ALERT]) == []
    assert (plain.logins, plain.letters) == ([], [])
    assert "secret" not in caplog.text


def test_a_server_that_offers_starttls_gets_log_in_and_letter_under_it(
    post_office, localhost_tls, tmp_path, monkeypatch, caplog
):
    tls, certificate = localhost_tls
    server = post_office(tls, is_asked_for_tls=True)
    mail = Mail.at(f"smtp://ann:a%40secret@localhost:{server.port}/?to=ann@example.org")
    teller = AlertDispatcher(StateFolder(tmp_path), [mail], pause=0.0)
    assert teller.tell([ALERT]) == []
    # The untrusted certificate was refused: nothing was sent after it.
    assert server.verbs == ["EHLO", "STARTTLS"]
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    server.verbs.clear()
    assert teller.tell([ALERT]) == [ALERT]
    assert server.verbs[:4] == ["EHLO", "STARTTLS", "EHLO", "AUTH"]
    assert server.logins == [("ann", "a@secret")]
    assert server.letters[0]["to"] == ["ann@example.org"]
    assert "secret" not in caplog.text


def test_each_way_is_told_once_though_another_fails(post_office, tmp_path):
    server = post_office()
    server.answers += ["451 later"]
    mail = Mail.at(f"smtp://127.0.0.1:{server.port}/?to=ann@example.org")
    senders = [Webhook("http://127.0.0.1:9/"), mail]
    teller = AlertDispatcher(StateFolder(tmp_path), senders, pause=0.0)
    assert teller.tell([ALERT]) == []
    assert server.letters == []
    assert teller.tell([ALERT]) == []
    assert teller.tell([ALERT]) == []
    assert len(server.letters) == 1


def test_ways_are_named_by_the_environment_and_a_bad_one_says_no_secret():
    assert senders_of({}) == ()
    mail = "smtps://a:b@mail.example.org/?to=c@example.org"
    found = senders_of({"WORLDPOSE_ALERT_URL": "http://hook/", "WORLDPOSE_ALERT_MAIL": mail})
    assert [each.name for each in found] == ["webhook", "mail"]
    assert (found[1].host, found[1].port) == ("mail.example.org", 465)
    for bad in (
        "mail.example.org",
        "smtp://ann:secret@mail/",
        "http://secret/?to=a",
        "smtp://x:y/",
    ):
        with pytest.raises(UsageError) as refused:
            senders_of({"WORLDPOSE_ALERT_MAIL": bad})
        assert "secret@" not in str(refused.value)


FILE = """
webhook = "{webhook}"

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


def test_channels_of_a_file_get_a_test_alert_by_a_command(post_office, webhook, tmp_path):
    project = tmp_path / "project"
    server = post_office()
    text = FILE.format(webhook=webhook.address, port=server.port)
    file = write_settings(project, text)
    command = ("serve", "--test-alerts", "--project", project)
    answer = succeed(*command)
    assert answer.out.splitlines() == [
        "webhook: accepted a test alert",
        "mail: accepted a test alert",
    ]
    ((_, posted),) = webhook.posted
    assert posted["alert"] == "test" and "arrive here" in posted["text"]
    (letter,) = server.letters
    assert set(letter["to"]) == {"ada@example.org", "bob@example.org"}
    assert letter["message"]["From"] == "worldpose@example.org"
    # The environment comes first; a channel that fails is named, without its address.
    webhook.codes = [403]
    answer = worldpose(*command, "--json", environment={"WORLDPOSE_ALERT_URL": webhook.address})
    assert (answer.code, answer.json["channels"]) == (1, {"webhook": "HTTPError 403", "mail": ""})
    assert "secret" not in answer.out + answer.err
    file.unlink()
    answer = worldpose(*command)
    assert answer.code == 2 and "found none" in answer.err


@pytest.mark.parametrize(
    ("text", "mode", "problem"),
    [
        ("webhook = 'http://h/'", 0o644, "mode 644"),
        ("webhook = http://secret/", 0o600, "may hold a secret"),
        ("hook = 'http://secret/'", 0o600, "hook"),
        ("[mail]\nserver = 'smtp://h'\nreceivers = []", 0o600, "mail.receivers"),
        ("[mail]\nserver = 'secret'\nreceivers = ['a@b']", 0o600, "may hold a secret"),
        ("webhook = 'secret'", 0o600, "may hold a secret"),
    ],
)
def test_a_bad_file_is_refused_without_its_secrets(text, mode, problem, tmp_path):
    file = write_settings(tmp_path, text, mode)
    with pytest.raises(UsageError, match=problem) as refused:
        senders_of({}, file)
    assert "http://secret" not in str(refused.value)
    assert senders_of({}, tmp_path / "absent") == ()


def test_a_login_of_the_file_may_have_any_characters(tmp_path):
    login = "server = 'smtps://h:4650'\nuser = 'a@b'\npassword = 'p:/?#@ä'"
    file = write_settings(tmp_path, f"[mail]\n{login}\nreceivers = ['c+d@e']")
    (mail,) = senders_of({}, file)
    assert (mail.host, mail.port, mail.user, mail.password) == ("h", 4650, "a@b", "p:/?#@ä")
    assert (mail.sender, mail.receivers, mail.is_secure) == ("c+d@e", ("c+d@e",), True)
