"""Artifacts of a deployment's run in Prefect's dashboard: progress, unit table, links."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import quote
from uuid import UUID

from prefect.artifacts import (
    create_link_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)

from flows.method import METHOD
from flows.progress import Reporter, in_short, reporting_to
from flows.service.layout import served_state
from flows.service.overview import Overview
from worldpose.store import Store

LOG = logging.getLogger("worldpose.operations")


class ArtifactReporter(Reporter):
    """Progress as an artifact, in addition to the log lines.

    Attributes:
        artifact: the progress artifact; None if there is none.
    """

    def __init__(self, artifact: UUID | None) -> None:
        self.artifact = artifact
        self._at = 0
        self._missing = 0

    def stage_started(self, stage: str, about: str, *, units: int, missing: int) -> None:
        """Report that all stages before are done."""
        super().stage_started(stage, about, units=units, missing=missing)
        self._at = [each.name for each in METHOD].index(stage)
        self._missing = missing
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
        artifact = self.artifact
        if artifact is not None:
            within = 1.0 - self.left / self._missing if self._missing else 0.0
            percent = 100.0 * (self._at + min(within, 1.0)) / len(METHOD)
            _show_artifact(lambda: update_progress_artifact(artifact, percent, description=text))


@contextmanager
def shown_at_prefect(store: Store, match_id: str) -> Iterator[None]:
    """Show progress of the enclosed run, and its outcome afterwards.

    Failures to show it are logged and stop nothing.

    Args:
        store: the project.
        match_id: the match.
    """
    key = re.sub(r"[^a-z0-9]+", "-", match_id.lower()).strip("-")
    artifact = _show_artifact(lambda: create_progress_artifact(0.0, key=f"progress-{key}"))
    reporter = ArtifactReporter(artifact)
    with reporting_to(reporter):
        yield
    if artifact is not None:
        _show_artifact(lambda: update_progress_artifact(artifact, 100.0, description="recorded"))
    _show_artifact(lambda: create_table_artifact(table_of(store, match_id), key=f"units-{key}"))
    serving = served_state(store.url).read_serving()
    pages = None if serving is None else serving.services.get("pages")
    if pages is not None and pages.address is not None:
        review = f"{pages.address}/#/match/{quote(match_id, safe='')}"
        _show_artifact(
            lambda: create_link_artifact(review, f"Review {match_id}", key=f"review-{key}")
        )
        status = f"{pages.address}/status"
        _show_artifact(lambda: create_link_artifact(status, "Status of all matches", key="status"))


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
            "figures": in_short(unit.figures),
        }
        for stage, unit in match.units
    ]


def _show_artifact(show: Callable[[], Any]) -> Any:  # noqa: ANN401 - whatever Prefect gives
    try:
        return show()
    except Exception as error:
        LOG.warning("not shown at Prefect: %s", error)
        return None
