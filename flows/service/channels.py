"""Channels of alerts: a webhook that gets JSON, and every service that Apprise knows."""

from __future__ import annotations

import logging
import stat
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, quote, urlencode, urlsplit

import apprise
import httpx
from pydantic import Field, ValidationError

from data_contracts.records import Record
from worldpose.errors import UsageError

ANSWER_SECONDS: Final = 10.0
"""Timeout for a webhook's response."""
ASSET: Final = apprise.AppriseAsset(app_id="worldpose", app_desc="worldpose alerts")
"""The sender's name in chats and mails."""


class DeliveryError(Exception):
    """A channel did not take a message."""


@dataclass(frozen=True)
class Channel:
    """One channel; its address can contain a secret, and is never printed.

    The address is that of a webhook, or an Apprise URL.
    """

    name: str
    address: str

    def send(self, content: Mapping[str, str]) -> None:
        """Deliver a message with keys `alert`, `match`, `text` and `link`, or raise an error."""
        if self.address.startswith(("http://", "https://")):
            # A redirect is an error: it would make the POST a GET.
            answer = httpx.post(self.address, json=dict(content), timeout=ANSWER_SECONDS)
            if not answer.is_success:
                raise DeliveryError(f"it answered {answer.status_code}")
            return
        sender = apprise.Apprise(asset=ASSET)
        sender.add(self.address)
        about = ", ".join(filter(None, [content["alert"].replace("_", " "), content["match"]]))
        body = f"{content['text']}\n\n{content['link']}".strip()
        with apprise.LogCapture(level=logging.WARNING, fmt="%(message)s") as said:
            if not sender.notify(
                body, f"worldpose: {about}", body_format=apprise.NotifyFormat.TEXT
            ):
                raise DeliveryError(" ".join(said.getvalue().split()))


class MailSettings(Record):
    """Table `mail` of alerts.toml."""

    server: str
    """`smtps://HOST[:PORT]`, or `smtp://`: STARTTLS if there is a login, else no TLS."""
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
    channels: tuple[str, ...] = ()
    """Apprise URLs."""
    mail: MailSettings | None = None
    """Mail server and receivers."""


def apprise_mail(address: str) -> str:
    """Return the Apprise URL of `smtps://USER:PASSWORD@HOST/?to=A@B&to=C@D&from=E@F`, or `smtp:`.

    UsageError if the address is malformed.
    """
    try:
        parts = urlsplit(address)
        asked = parse_qs(parts.query)
        is_secure = {"smtps": True, "smtp": False}[parts.scheme]
        port = parts.port or (465 if is_secure else 25)
        to, (server,) = asked["to"], [parts.hostname or ""]
        if not server:
            raise ValueError
    except (KeyError, ValueError):
        raise UsageError(
            "the mail of alerts (WORLDPOSE_ALERT_MAIL, alerts.toml)",
            expected="smtps://USER:PASSWORD@HOST/?to=SOMEBODY@EXAMPLE.ORG",
            found="something else, which may hold a secret",
            todo="Correct it, or remove it to send no mail.",
        ) from None
    login = parts.netloc.rpartition("@")[0]
    mode = "ssl" if is_secure else "starttls" if login else "insecure"
    query = {"mode": mode, "from": asked.get("from", to)[0], "to": ",".join(to), "format": "text"}
    scheme = "mailto" if mode == "insecure" else "mailtos"
    return f"{scheme}://{login}{'@' * bool(login)}{server}:{port}/?{urlencode(query)}"


def read_alert_settings(file: Path) -> AlertSettings:
    """Return the channels that a file names; none if there is no file.

    UsageError if the file is malformed, or other users can read it.
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
        expected="`webhook`, `channels`, and a table `mail` with server, receivers, user, password",
        found=problem,
        todo="Correct the file; docs/how-to/operations.md has an example.",
    )


def channels_of(environment: Mapping[str, str], file: Path | None = None) -> tuple[Channel, ...]:
    """Return the channels of WORLDPOSE_ALERT_URL and WORLDPOSE_ALERT_MAIL, else of alerts.toml.

    UsageError if a variable or the file is malformed.
    """
    kept = AlertSettings() if file is None else read_alert_settings(file)
    urls = environment.get("WORLDPOSE_ALERT_URL", "").split()
    urls = urls or [*filter(None, [kept.webhook]), *kept.channels]
    mail = environment.get("WORLDPOSE_ALERT_MAIL") or (kept.mail and kept.mail.address)
    named = [(_kind(url), url) for url in urls]
    named += [("mail", apprise_mail(mail))] if mail else []
    seen: Counter[str] = Counter()
    found = []
    for kind, url in named:
        seen[kind] += 1
        found.append(Channel(kind if seen[kind] == 1 else f"{kind} {seen[kind]}", url))
    return tuple(found)


def _kind(address: str) -> str:
    """Return `webhook`, or the service of an Apprise URL."""
    try:
        parts = urlsplit(address)
        is_web = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        parts, is_web = urlsplit(""), False
    if is_web:
        return "webhook"
    if parts.scheme in ("", "http", "https") or apprise.Apprise.instantiate(address) is None:
        raise UsageError(
            "a channel of alerts (WORLDPOSE_ALERT_URL, alerts.toml)",
            expected="https://HOST/PATH, or an Apprise URL as slack://TOKENS",
            found="something else, which may hold a secret",
            todo="Correct it as https://appriseit.com/services shows, or remove it.",
        )
    return parts.scheme


TEST_ALERT: Final = {
    "alert": "test",
    "match": "",
    "text": "This is a test: alerts of worldpose arrive here.",
    "link": "",
}


def send_test(channels: Iterable[Channel]) -> dict[str, str]:
    """Send a test alert to each channel; return channel to problem, empty if it was accepted."""
    found = {}
    for channel in channels:
        try:
            channel.send(TEST_ALERT)
        except DeliveryError as error:
            found[channel.name] = str(error)
        except Exception as error:  # its message can contain the address, and that a secret
            found[channel.name] = type(error).__name__
        else:
            found[channel.name] = ""
    return found
