"""Artifacts of a deployment's run in Prefect's dashboard: progress and table of units."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from uuid import UUID

from prefect.artifacts import (
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)

from flows.progress import Reporter, format_duration, reporting_to
from flows.review.metric_words import in_short
from flows.service.match_runs import artifact_key
from flows.service.overview import Overview
from worldpose.store.store import Store

LOG = logging.getLogger("worldpose.operations")


class ArtifactReporter(Reporter):
    """Progress as an artifact, in addition to the log lines.

    Attributes:
        artifact: the progress artifact; None if there is none.
    """

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
def show_at_prefect(store: Store, match_id: str) -> Iterator[None]:
    """Show progress of the enclosed run, and its outcome afterwards.

    Failures to show it are logged and stop nothing.

    Args:
        store: the project.
        match_id: the match.
    """
    key = artifact_key(match_id)
    artifact = _show_artifact(lambda: create_progress_artifact(0.0, key=f"progress-{key}"))
    reporter = ArtifactReporter(artifact)
    with reporting_to(reporter):
        yield
    if artifact is not None:
        _show_artifact(lambda: update_progress_artifact(artifact, 100.0, description="recorded"))
    _show_artifact(lambda: create_table_artifact(table_of(store, match_id), key=f"units-{key}"))


def table_of(store: Store, match_id: str) -> list[dict[str, Any]]:
    """Return a row for each unit of the match's latest run."""
    (match,) = [each for each in Overview(store).look() if each.match_id == match_id]
    return [
        {
            "stage": stage,
            "camera or clip": unit.unit,
            "state": unit.state,
            "seconds": None if unit.seconds is None else round(unit.seconds, 2),
            "why": unit.why,
            "metrics": in_short(unit.figures),
        }
        for stage, unit in match.units
    ]


def _show_artifact(show: Callable[[], Any]) -> Any:  # noqa: ANN401 - whatever Prefect gives
    try:
        return show()
    except Exception as error:
        LOG.warning("not shown at Prefect: %s", error)
        return None
