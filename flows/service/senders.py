"""Channels for alerts: a webhook and e-mail, each given by an address."""

from __future__ import annotations

import json
import smtplib
import ssl
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from email.message import EmailMessage
from typing import Final, Protocol
from urllib.parse import parse_qs, unquote, urlsplit

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
                "WORLDPOSE_ALERT_URL",
                expected="https://HOST/PATH (or http:)",
                found="something else, which may hold a secret",
                todo="Correct the variable, or unset it to post nothing.",
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
                "WORLDPOSE_ALERT_MAIL",
                expected="smtps://USER:PASSWORD@HOST/?to=SOMEBODY@EXAMPLE.ORG",
                found="something else, which may hold a secret",
                todo="Correct the variable, or unset it to send no mail.",
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


def senders_of(environment: Mapping[str, str]) -> tuple[Sender, ...]:
    """Return the channels in WORLDPOSE_ALERT_URL and WORLDPOSE_ALERT_MAIL.

    Raises:
        UsageError: one of them is malformed.
    """
    webhook, mail = environment.get("WORLDPOSE_ALERT_URL"), environment.get("WORLDPOSE_ALERT_MAIL")
    found: list[Sender] = [Webhook.at(webhook)] if webhook else []
    return (*found, Mail.at(mail)) if mail else tuple(found)
