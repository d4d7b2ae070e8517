"""Channels for alerts: a webhook and e-mail, each given by an address."""

from __future__ import annotations

import json
import smtplib
import ssl
import stat
import tomllib
import urllib.request
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from email.message import EmailMessage
from pathlib import Path
from typing import Final, Protocol
from urllib.parse import parse_qs, quote, unquote, urlencode, urlsplit

from pydantic import Field, ValidationError

from data_contracts.records import Record
from worldpose.errors import UsageError

ANSWER_SECONDS: Final = 10.0
"""Timeout for a server's response."""


class Sender(Protocol):
    """One channel; its address can contain a secret, and is never printed."""

    @property
    def name(self) -> str:
        """Name in logs and in the state folder."""

    def send(self, content: Mapping[str, str]) -> None:
        """Deliver the message.

        Raises:
            Exception: it was not accepted.
        """


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Treats a 3xx response as an error."""

    def redirect_request(self, *_: object) -> None:
        return None


@dataclass(frozen=True)
class Webhook:
    """POST request with JSON; chat services show its `text`."""

    address: str
    name: str = "webhook"

    @classmethod
    def at(cls, address: str) -> Webhook:
        """Parse the http: or https: address of a webhook.

        Raises:
            UsageError: the address is malformed.
        """
        try:
            parts = urlsplit(address)
            is_web = parts.scheme in ("http", "https") and bool(parts.hostname)
            port = parts.port
        except ValueError:
            is_web, port = False, None
        if not is_web or port == 0:
            raise UsageError(
                "the webhook of alerts (WORLDPOSE_ALERT_URL, alerts.toml)",
                expected="https://HOST/PATH (or http:)",
                found="something else, which may hold a secret",
                todo="Correct it, or remove it to post nothing.",
            )
        return cls(address)

    def send(self, content: Mapping[str, str]) -> None:
        """See `Sender`. Redirects are not followed: a POST would become a GET."""
        headers = {"content-type": "application/json", "user-agent": "worldpose"}
        body = json.dumps(content).encode()
        request = urllib.request.Request(self.address, data=body, headers=headers)
        opener = urllib.request.build_opener(_NoRedirects)
        with opener.open(request, timeout=ANSWER_SECONDS) as answer:
            if not 200 <= answer.status < 300:
                raise ValueError(f"it answered {answer.status}")


@dataclass(frozen=True)
class Mail:
    """Message by SMTP.

    Attributes:
        host: mail server.
        port: its port.
        is_secure: TLS from the start; else STARTTLS if the server offers it.
        user: login name, only used under TLS; empty = no login.
        password: password of the user.
        sender: sender address.
        receivers: recipient addresses.
    """

    host: str
    port: int
    is_secure: bool
    user: str
    password: str
    sender: str
    receivers: tuple[str, ...]
    name: str = "mail"

    @classmethod
    def at(cls, address: str) -> Mail:
        """Parse `smtps://USER:PASSWORD@HOST/?to=A@B&to=C@D&from=E@F`; `smtp:` starts without TLS.

        Raises:
            UsageError: the address is malformed.
        """
        try:
            parts = urlsplit(address)
            asked = parse_qs(parts.query)
            is_secure = parts.scheme == "smtps"
            port = parts.port or (465 if is_secure else 25)
            host, receivers = parts.hostname, tuple(asked["to"])
            sender = asked.get("from", [receivers[0]])[0]
            if parts.scheme not in ("smtp", "smtps") or host is None:
                raise ValueError
        except (KeyError, ValueError):
            raise UsageError(
                "the mail of alerts (WORLDPOSE_ALERT_MAIL, alerts.toml)",
                expected="smtps://USER:PASSWORD@HOST/?to=SOMEBODY@EXAMPLE.ORG",
                found="something else, which may hold a secret",
                todo="Correct it, or remove it to send no mail.",
            ) from None
        user, password = unquote(parts.username or ""), unquote(parts.password or "")
        return cls(host, port, is_secure, user, password, sender, receivers)

    def send(self, content: Mapping[str, str]) -> None:
        """See `Sender`."""
        message = EmailMessage()
        # A header is one line, even if an error message has several.
        message["Subject"] = " ".join(f"worldpose: {content['text']}".split())[:150]
        message["From"], message["To"] = self.sender, ", ".join(self.receivers)
        message.set_content(f"{content['text']}\n\n{content['link']}\n")
        context = ssl.create_default_context()
        if self.is_secure:
            server: smtplib.SMTP = smtplib.SMTP_SSL(
                self.host, self.port, timeout=ANSWER_SECONDS, context=context
            )
        else:
            server = smtplib.SMTP(self.host, self.port, timeout=ANSWER_SECONDS)
        with server:
            server.ehlo()
            is_secret = self.is_secure
            if not is_secret and server.has_extn("starttls"):
                server.starttls(context=context)
                is_secret = True
            if self.user:
                if not is_secret:
                    raise ValueError("the server offers no TLS to log in under")
                server.login(self.user, self.password)
            server.send_message(message)


class MailSettings(Record):
    """Table `mail` of alerts.toml."""

    server: str
    """`smtps://HOST[:PORT]`, or `smtp://` for STARTTLS."""
    user: str = ""
    """Login name; empty = no login."""
    password: str = ""
    """Its password."""
    sender: str | None = None
    """Address of the sender; None = the first receiver."""
    receivers: tuple[str, ...] = Field(min_length=1)
    """Addresses."""

    @property
    def address(self) -> str:
        """The address of `WORLDPOSE_ALERT_MAIL` that says the same."""
        scheme, _, host = self.server.partition("://")
        login = f"{quote(self.user, safe='')}:{quote(self.password, safe='')}@" if self.user else ""
        asked = [("to", each) for each in self.receivers]
        asked += [] if self.sender is None else [("from", self.sender)]
        return f"{scheme}://{login}{host.rstrip('/')}/?{urlencode(asked)}"


class AlertSettings(Record):
    """alerts.toml: the channels of a project's alerts."""

    webhook: str | None = None
    """Address that gets each alert as JSON."""
    mail: MailSettings | None = None
    """Mail server and receivers."""


def read_alert_settings(file: Path) -> AlertSettings:
    """Return the channels that a file names; none if there is no file.

    Raises:
        UsageError: the file is malformed, or other users can read it.
    """
    try:
        content = file.read_bytes()
        mode = stat.S_IMODE(file.stat().st_mode)
    except FileNotFoundError:
        return AlertSettings()
    if mode & 0o077:
        raise UsageError(
            str(file),
            expected="a file that only its owner can read: it can hold a password",
            found=f"mode {mode:o}",
            todo=f"Change it: chmod 600 {file}.",
        )
    try:
        return AlertSettings.model_validate(tomllib.loads(content.decode()))
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    except ValueError:  # neither TOML nor UTF-8; its message can quote a secret
        problem = "something else, which may hold a secret"
    raise UsageError(
        str(file),
        expected="`webhook`, and a table `mail` with server, receivers, user, password, sender",
        found=problem,
        todo="Correct the file; docs/how-to/operations.md has an example.",
    )


def senders_of(environment: Mapping[str, str], file: Path | None = None) -> tuple[Sender, ...]:
    """Return the channels of WORLDPOSE_ALERT_URL and WORLDPOSE_ALERT_MAIL, else of alerts.toml.

    Raises:
        UsageError: a variable or the file is malformed.
    """
    kept = AlertSettings() if file is None else read_alert_settings(file)
    webhook = environment.get("WORLDPOSE_ALERT_URL") or kept.webhook
    mail = environment.get("WORLDPOSE_ALERT_MAIL") or (kept.mail and kept.mail.address)
    found: list[Sender] = [Webhook.at(webhook)] if webhook else []
    return (*found, Mail.at(mail)) if mail else tuple(found)


TEST_ALERT: Final = {
    "alert": "test",
    "match": "",
    "text": "This is a test: alerts of worldpose arrive here.",
    "link": "",
}


def send_test(senders: Iterable[Sender]) -> dict[str, str]:
    """Send a test alert to each channel; return channel to problem, empty if it was accepted."""
    found = {}
    for sender in senders:
        try:
            sender.send(TEST_ALERT)
        except Exception as error:  # its message can contain the address, and that a secret
            code = getattr(error, "code", None) or getattr(error, "smtp_code", None)
            found[sender.name] = type(error).__name__ + (f" {code}" if code else "")
        else:
            found[sender.name] = ""
    return found
