"""Secrets of a served project: their files, and the parts that receive them."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from secrets import token_urlsafe
from typing import Final

from flows.orchestration.prefect_environment import (
    CLIENT_LOGIN,
    CLOUD_LOGIN,
    DATABASE,
    SERVER_LOGIN,
    new_login,
)
from flows.service.plan import ServePlan
from flows.web.proxy import TOKEN_LENGTH
from worldpose.errors import UsageError
from worldpose.formats.files import whole_file

ALERTS: Final = ("WORLDPOSE_ALERT_URL", "WORLDPOSE_ALERT_MAIL")
LINEAGE: Final = "OPENLINEAGE_API_KEY"
"""Key of the receiver of lineage, which the runs of the worker need."""
PAGES_TOKEN: Final = "WORLDPOSE_REVIEW_TOKEN"
METRICS_TOKEN: Final = "WORLDPOSE_METRICS_TOKEN"


@dataclass(frozen=True)
class Secrets:
    """Secrets of a served project's parts, passed as environment variables.

    `prefect` is the login of its server; None = an external server without login.
    """

    pages: str
    metrics: str
    prefect: str | None

    def of(self, part: str, plan: ServePlan) -> dict[str, str]:
        """Return only the secrets that a part needs."""
        urls = [plan.project, *([plan.bucket or ""] if part == "watch" else [])]
        cloud = [name for name in os.environ if name.startswith("AWS_")]
        names = {
            "prefect": DATABASE,
            "worker": (CLOUD_LOGIN, LINEAGE),
            "watch": (CLOUD_LOGIN, *ALERTS),
            "pages": (CLOUD_LOGIN,),
        }[part]
        if part != "prefect" and any("://" in url for url in urls):
            names = (*names, *cloud)
        found = {name: os.environ[name] for name in names if name in os.environ}
        if part == "prefect":
            found[SERVER_LOGIN] = self.prefect or ""
        elif self.prefect is not None:
            found[CLIENT_LOGIN] = self.prefect
        own = {"watch": {METRICS_TOKEN: self.metrics}, "pages": {PAGES_TOKEN: self.pages}}
        return found | own.get(part, {})


def secrets_of(plan: ServePlan, pages: str) -> Secrets:
    """Return the secrets of a project before it is served; stored secrets are created once.

    Raises:
        UsageError: the token for metrics is short.
    """
    metrics = os.environ.get(METRICS_TOKEN)
    if metrics is not None and len(metrics) < TOKEN_LENGTH:
        raise UsageError(
            METRICS_TOKEN,
            expected=f"at least {TOKEN_LENGTH} characters",
            found=f"{len(metrics)}",
            todo="Create a token with: openssl rand -hex 16.",
        )
    state = plan.state_folder
    if metrics is None:
        metrics = kept_secret(state.metrics_token, lambda: token_urlsafe(24))
    login = os.environ.get(CLIENT_LOGIN)
    if plan.owns_prefect:
        given = os.environ.get(SERVER_LOGIN)
        login = given or kept_secret(state.prefect_login, new_login)
    return Secrets(pages, metrics, login)


def kept_secret(file: Path, make: Callable[[], str]) -> str:
    """Return a secret from a file that only this user can read; create it if missing.

    A secret that other users can read or write is replaced. Only this user can read its folder.
    """
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    file.parent.chmod(0o700)
    try:
        with os.fdopen(os.open(file, os.O_RDONLY | os.O_NOFOLLOW)) as opened:
            known = os.fstat(opened.fileno())
            secret = opened.read().strip()
        if secret and known.st_uid == os.geteuid() and not stat.S_IMODE(known.st_mode) & 0o077:
            return secret
    except OSError:
        pass  # missing, a link, or another user's
    secret = make()
    with whole_file(file) as draft:
        draft.touch(mode=0o600)
        draft.chmod(0o600)
        draft.write_text(f"{secret}\n")
    return secret
