"""Artifacts of a deployment's run in Prefect's dashboard: its progress and links."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any
from urllib.parse import quote
from uuid import UUID

from prefect.artifacts import (
    create_link_artifact,
    create_progress_artifact,
    update_progress_artifact,
)

from flows.progress import Reporter, format_duration, reporting_to
from flows.service.match_runs import artifact_key

LOG = logging.getLogger("worldpose.operations")


class ArtifactReporter(Reporter):
    """Progress as an artifact, in addition to the log lines."""

    def __init__(self, artifact: UUID | None) -> None:
        self.artifact = artifact

    def stage_started(self, stage: str, about: str, *, units: int, missing: int) -> None:
        """Report that all stages before are done."""
        super().stage_started(stage, about, units=units, missing=missing)
        self._tell(f"{stage}: {about}")

    def tell_of(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Report progress of the stage."""
        super().tell_of(unit, seconds, figures)
        self._tell(unit)

    def unit_failed(self, unit: str, message: str) -> None:
        """Count the failed unit as finished."""
        super().unit_failed(unit, message)
        self._tell(f"{unit} failed")

    def _tell(self, text: str) -> None:
        artifact, at = self.artifact, self.run_progress
        if artifact is None:
            return
        if at.seconds_left is not None:
            text += f", about {format_duration(at.seconds_left)} left"
        _show_artifact(lambda: update_progress_artifact(artifact, 100.0 * at.share, text))


@contextmanager
def show_at_prefect(match_id: str) -> Iterator[None]:
    """Show progress of the enclosed run; failures to show it are logged and stop nothing."""
    key = f"progress-{artifact_key(match_id)}"
    artifact = _show_artifact(lambda: create_progress_artifact(0.0, key=key))
    reporter = ArtifactReporter(artifact)
    with reporting_to(reporter):
        yield
    if artifact is not None:
        _show_artifact(lambda: update_progress_artifact(artifact, 100.0, description="recorded"))


def link_pages(pages: str, match_id: str) -> None:
    """Link this flow run to the pages of its match, which have an address."""
    links = {
        f"review-{artifact_key(match_id)}": (
            f"Review {match_id}",
            f"{pages}/#/match/{quote(match_id, safe='')}",
        ),
        "status": ("Status of all matches", f"{pages}/status"),
    }
    for key, (text, address) in links.items():
        _show_artifact(partial(create_link_artifact, address, text, key=key))


def _show_artifact(show: Callable[[], Any]) -> Any:  # noqa: ANN401 - whatever Prefect gives
    try:
        return show()
    except Exception as error:
        LOG.warning("not shown at Prefect: %s", error)
        return None
