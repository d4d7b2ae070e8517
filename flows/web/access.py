"""Access to the pages: a login token, signed sessions, and a form secret per session."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from threading import Lock
from typing import Final

from flows.web.host_guard import LOOPBACK as LOOPBACK
from worldpose.errors import UsageError

SESSION_SECONDS: Final = 12 * 3600
"""A working day; after it, people log in again."""
TOKEN_LENGTH: Final = 16
"""Minimum length of a chosen token [characters]."""
NAME_LENGTH: Final = 80
"""Maximum length of a person's name [characters]."""
WRONG_TOKENS: Final = 5
"""Wrong tokens from one address within `WRONG_SECONDS`; further ones are refused unchecked."""
WRONG_SECONDS: Final = 10.0
MOST_REMEMBERED: Final = 10_000
"""Wrong tokens and ended sessions that are remembered, the latest."""


@dataclass(frozen=True)
class Access:
    """Login token and sessions of the pages.

    Sessions are signed with a key derived from the token: they survive a restart of the server with
    the same token, and all end when it changes. A session after logout is refused until the process
    ends.

    Attributes:
        token: login token.
        hosts: names under which browsers reach the server; any other name is a foreign one that
            points here.
        secure: whether pages are served with TLS.
    """

    token: str
    hosts: frozenset[str] = LOOPBACK
    secure: bool = False
    _ended: dict[str, float] = field(default_factory=dict, init=False, compare=False)
    _wrong: list[tuple[float, str]] = field(default_factory=list, init=False, compare=False)
    _lock: Lock = field(default_factory=Lock, init=False, compare=False)

    @property
    def cookie(self) -> str:
        """Name of the session cookie: servers on one machine do not end each other's sessions."""
        return f"worldpose_review_{self._sign('cookie')[:8]}"

    def session(self, who: str, now: float | None = None) -> str:
        """Return a new session for `who`, as the cookie's value."""
        until = (time.time() if now is None else now) + SESSION_SECONDS
        content = json.dumps({"who": who, "until": until, "nonce": secrets.token_hex(8)})
        packed = base64.urlsafe_b64encode(content.encode()).decode().rstrip("=")
        return f"{packed}.{self._sign('session', packed)}"

    def person(self, session: str | None, now: float | None = None) -> str | None:
        """Return the person of a session cookie; None if it is forged, expired or missing."""
        packed, _, signature = (session or "").partition(".")
        if not self._same(signature, self._sign("session", packed)):
            return None
        content = json.loads(base64.urlsafe_b64decode(packed + "=" * (-len(packed) % 4)))
        if content["until"] < (time.time() if now is None else now) or signature in self._ended:
            return None
        return str(content["who"])

    def end(self, session: str) -> None:
        """Refuse a session from now on: its person has logged out."""
        with self._lock:
            self._ended[session.partition(".")[2]] = time.time()
            while len(self._ended) > MOST_REMEMBERED:
                self._ended.pop(next(iter(self._ended)))

    def may_try(self, address: str, now: float | None = None) -> bool:
        """Return whether to check a token from this address: not after many recent wrong ones."""
        since = (time.monotonic() if now is None else now) - WRONG_SECONDS
        with self._lock:
            self._wrong[:] = [each for each in self._wrong if each[0] > since][-MOST_REMEMBERED:]
            return sum(each[1] == address for each in self._wrong) < WRONG_TOKENS

    def note_wrong(self, address: str, now: float | None = None) -> None:
        """Remember that this address sent a wrong token."""
        with self._lock:
            self._wrong.append((time.monotonic() if now is None else now, address))

    def form_secret(self, session: str) -> str:
        """Return the secret that a page of this session sends with every change."""
        return self._sign("form", session)

    def has_form_secret(self, session: str, given: str) -> bool:
        """Return whether this is the session's form secret, in constant time."""
        return self._same(given, self.form_secret(session))

    def has_token(self, given: str) -> bool:
        """Return whether this is the token, in constant time."""
        return self._same(given, self.token)

    def _sign(self, *parts: str) -> str:
        text = "\n".join(parts).encode()
        return hmac.new(self.token.encode(), text, hashlib.sha256).hexdigest()

    def _same(self, given: str, right: str) -> bool:
        # JSON strings can contain lone surrogates, which have no UTF-8 bytes.
        return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), right.encode())


def access_for(host: str, *, token: str | None, names: Iterable[str], secure: bool) -> Access:
    """Create the access control of a server that listens at `host`.

    Args:
        host: address to listen at.
        token: chosen token; None = a random one, printed when the server starts.
        names: further names of the machine that browsers use.
        secure: whether TLS is used.

    Raises:
        UsageError: the token is short, or the server would listen to other machines without a
            chosen token or without a name.
    """
    if token is not None and len(token) < TOKEN_LENGTH:
        raise UsageError(
            "WORLDPOSE_REVIEW_TOKEN",
            expected=f"at least {TOKEN_LENGTH} characters",
            found=f"{len(token)}",
            todo="Create a token with: openssl rand -hex 16.",
        )
    hosts = {name.lower() for name in (*LOOPBACK, *names, host)} - {"0.0.0.0", "::"}
    if host not in LOOPBACK:
        if token is None:
            raise UsageError(
                f"--host {host}",
                expected="WORLDPOSE_REVIEW_TOKEN, which people log in with from other machines",
                found="none",
                todo="Set it, or omit --host and connect to the pages with: ssh -L.",
            )
        if hosts == LOOPBACK:
            raise UsageError(
                f"--host {host}",
                expected="--host-name, under which browsers find this machine",
                found="none",
                todo="Add the name, as in --host-name review.example.org.",
            )
    return Access(token or secrets.token_urlsafe(24), frozenset(hosts), secure)
