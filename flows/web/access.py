"""Access to the pages: a login token, signed sessions, and a form secret per session."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import stat
import time
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Annotated, Final

from pydantic import Field, ValidationError

from data_contracts.records import Record
from flows.web.host_guard import LOOPBACK as LOOPBACK
from flows.web.proxy import NAME_LENGTH, TOKEN_LENGTH, Proxy, Role
from worldpose.errors import UsageError

SESSION_SECONDS: Final = 12 * 3600
"""A working day; after it, people log in again."""
WRONG_TOKENS: Final = 5
"""Wrong tokens at once, of all unknown browsers together or of one known one; further ones are
refused unchecked."""
FORGIVEN_SECONDS: Final = 1.0
"""Time that allows one more guess."""
KNOWN_SECONDS: Final = 90 * 86400
"""Time for which a browser is known after its person has logged in."""
MOST_REMEMBERED: Final = 10_000
"""Known browsers with wrong tokens and ended sessions that are remembered, the latest."""


EDITING: Final = ("/corrections", "/withdrawals", "/withdrawal", "/acceptances", "/interpolation")
"""Suffixes of the paths by which an annotator changes something."""
OF_ALL: Final = ("/api/logout", "/preview")
"""Suffixes of the paths that change nothing of the project."""


class User(Record):
    """Entry of a file of users, under the person's name."""

    role: Role
    """Actions that the person is allowed."""
    token: str = Field(min_length=TOKEN_LENGTH)
    """The person's own login token."""


class UserFile(Record):
    """The file users.toml: who may log in. Without the file, the access token admits every user."""

    users: dict[Annotated[str, Field(min_length=1, max_length=NAME_LENGTH)], User] = {}
    """Name to role and token."""
    proxy: Proxy | None = None
    """Proxy that logs further people in; None: people log in with their tokens alone."""


def read_users(file: Path) -> UserFile:
    """Return the people of a file and its proxy.

    UsageError if the file is missing or malformed, other users of the machine can read it, or two
    people have the same token.
    """
    problem = ""
    try:
        if stat.S_IMODE(file.stat().st_mode) & 0o077:
            problem = "one that others can read: chmod 600"
        found = UserFile.model_validate(tomllib.loads(file.read_text(encoding="utf-8")))
        users = found.users
        if not users and found.proxy is None:
            problem = "neither a user nor a proxy"
        elif len({user.token for user in users.values()}) < len(users):
            problem = "the same token of two people"
        elif not all(name.isprintable() for name in users):
            problem = "a name with characters that cannot be printed"
    except OSError as error:
        problem = str(error.strerror)
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    except ValueError:  # neither TOML nor UTF-8; its message can quote a token
        problem = "something else, which may hold a token"
    if problem:
        raise UsageError(
            f"--users {file}",
            expected="tables [users.NAME] with role and token, or [proxy], for its owner alone",
            found=problem,
            todo="Correct the file; docs/how-to/review.md has an example.",
        )
    return found


@dataclass(frozen=True)
class Access:
    """Login token and sessions of the pages.

    Sessions are signed with a key derived from the token: they survive a restart of the server with
    the same token, are valid on every server that has it, and all end when it changes.

    Attributes:
        token: login token.
        hosts: names under which browsers reach the server; any other name is a foreign one that
            points here.
        secure: whether pages are served with TLS.
        users: people with a role and a token of their own, by name; None = all with the login
            token is an approver.
        proxy: the proxy that logs further people in.
        ended: folder with a file for each session after logout, which all servers of a service
            refuse; None = this process alone remembers them.
    """

    token: str
    hosts: frozenset[str] = LOOPBACK
    secure: bool = False
    users: Mapping[str, User] | None = None
    proxy: Proxy | None = None
    ended: Path | None = None
    _ended: dict[str, float] = field(default_factory=dict, init=False, compare=False)
    _wrong: dict[str, tuple[float, float]] = field(default_factory=dict, init=False, compare=False)
    _lock: Lock = field(default_factory=Lock, init=False, compare=False)

    @property
    def cookie(self) -> str:
        """Name of the session cookie: servers on one machine do not end each other's sessions."""
        return f"worldpose_review_{self._sign('cookie')[:8]}"

    def session(self, who: str, now: float | None = None, *, by_proxy: bool = False) -> str:
        """Return a new session for `who`, as the cookie's value."""
        until = (time.time() if now is None else now) + SESSION_SECONDS
        parts = {"who": who, "own": self._sign_own(who, by_proxy), "until": until}
        content = json.dumps({**parts, "nonce": secrets.token_hex(8)})
        packed = base64.urlsafe_b64encode(content.encode()).decode().rstrip("=")
        return f"{packed}.{self._sign('session', packed)}"

    def person(
        self, session: str | None, now: float | None = None, *, by_proxy: bool = False
    ) -> str | None:
        """Return the person of a session cookie; None if it is forged, expired or missing.

        A session that began through the proxy is valid there alone.
        """
        packed, _, signature = (session or "").partition(".")
        if not self._same(signature, self._sign("session", packed)):
            return None
        content = json.loads(base64.urlsafe_b64decode(packed + "=" * (-len(packed) % 4)))
        own = self._sign_own(content["who"], by_proxy)
        if own is None or content.get("own") != own:  # also one of an earlier version
            return None
        if content["until"] < (time.time() if now is None else now) or signature in self._ended:
            return None
        if self.ended is not None and (self.ended / signature).exists():
            return None
        return str(content["who"])

    def end(self, session: str) -> None:
        """Refuse a session from now on: its person has logged out."""
        signature = session.partition(".")[2]
        with self._lock:
            self._ended[signature] = time.time()
            while len(self._ended) > MOST_REMEMBERED:
                self._ended.pop(next(iter(self._ended)))
            if self.ended is None:
                return
            self.ended.mkdir(mode=0o700, parents=True, exist_ok=True)
            (self.ended / signature).touch(0o600)
            for file in self.ended.iterdir():
                if file.stat().st_mtime < time.time() - SESSION_SECONDS:  # it has expired, too
                    file.unlink()

    def remember(self, who: str) -> str:
        """Return what a browser keeps after a login: guesses of others do not lock it out."""
        nonce = secrets.token_hex(8)
        return f"{nonce}.{self._sign('known', who, nonce)}"

    def guesser(self, who: str, known: str | None) -> str:
        """Return whose guesses count together: a known browser's of its person, or all others."""
        nonce, _, signature = (known or "").partition(".")
        return nonce if self._same(signature, self._sign("known", who, nonce)) else ""

    def may_try(self, guesser: str, now: float | None = None) -> bool:
        """Take a guess out of the budget of a guesser; return whether there was one left."""
        now = time.monotonic() if now is None else now
        with self._lock:
            used, at = self._wrong.pop(guesser, (0.0, now))
            used = max(0.0, used - (now - at) / FORGIVEN_SECONDS)
            is_allowed = used <= WRONG_TOKENS - 1
            self._wrong[guesser] = (used + is_allowed, now)
            while len(self._wrong) > MOST_REMEMBERED:
                self._wrong.pop(next(iter(self._wrong)))
            return is_allowed

    def forgive(self, guesser: str) -> None:
        """Give back the guess of the right token."""
        with self._lock:
            used, at = self._wrong[guesser]
            self._wrong[guesser] = (max(0.0, used - 1.0), at)

    def form_secret(self, session: str) -> str:
        """Return the secret that a page of this session sends with every change."""
        return self._sign("form", session)

    def has_form_secret(self, session: str, given: str) -> bool:
        """Return whether this is the session's form secret, in constant time."""
        return self._same(given, self.form_secret(session))

    def has_token(self, who: str, given: str) -> bool:
        """Return whether this is the person's token, in constant time."""
        if self.users is None:
            return self._same(given, self.token)
        user = self.users.get(who)
        return self._same(given, self.token if user is None else user.token) and user is not None

    def role(self, who: str | None) -> Role:
        """Return the role of a person who has logged in with a token."""
        user = None if self.users is None or who is None else self.users.get(who)
        return "approver" if user is None else user.role

    def may_change(self, role: Role, path: str) -> bool:
        """Return whether the role allows a request that changes what `path` names."""
        if role == "approver" or path.endswith(OF_ALL):
            return True
        return role == "annotator" and path.endswith(EDITING)

    def _sign_own(self, who: str, by_proxy: bool) -> str | None:
        """Return what a session holds of the person; None if no user of the name may log in."""
        if by_proxy:
            return self._sign("proxy")
        if self.users is None:
            return ""
        user = self.users.get(who)
        return None if user is None else self._sign("own", user.token)

    def _sign(self, *parts: str) -> str:
        text = "\n".join(parts).encode()
        return hmac.new(self.token.encode(), text, hashlib.sha256).hexdigest()

    def _same(self, given: str, right: str) -> bool:
        # JSON strings can contain lone surrogates, which have no UTF-8 bytes.
        return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), right.encode())


def access_for(
    host: str,
    *,
    token: str | None,
    names: Iterable[str],
    secure: bool,
    users: Path | None = None,
    ended: Path | None = None,
) -> Access:
    """Create the access control of a server that listens at `host`.

    Without a token, the server makes and prints a random one. `names` are further names of the
    machine that browsers use, `users` is the file of the people who may log in; None = all with the
    token. `ended` is as in `Access`. UsageError if the file or the token is not valid, or the
    server would listen to other machines without a chosen token or without a name.
    """
    if token is not None and len(token) < TOKEN_LENGTH:
        raise UsageError(
            "WORLDPOSE_REVIEW_TOKEN",
            expected=f"at least {TOKEN_LENGTH} characters",
            found=f"{len(token)}",
            todo="Create a token with: openssl rand -hex 16.",
        )
    read = None if users is None else read_users(users)
    people, proxy = (None, None) if read is None else (read.users, read.proxy)
    hosts = {name.lower() for name in (*LOOPBACK, *names, host)} - {"0.0.0.0", "::"}
    if host not in LOOPBACK:
        if token is None and people is None:
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
    token = token or secrets.token_urlsafe(24)
    return Access(token, frozenset(hosts), secure, people, proxy, ended)
