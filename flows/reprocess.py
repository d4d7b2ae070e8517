"""Scheduled flow that recomputes all results that edits made stale."""

from __future__ import annotations

from prefect import flow
from pydantic import JsonValue

from flows.reprocessing import reprocess_matches
from flows.running import RunRequest
from worldpose.errors import WorldposeError
from worldpose.store import Store


class UnprocessedError(WorldposeError):
    """Some matches could not be recomputed; the others are current."""


@flow(name="reprocess", validate_parameters=False)
def reprocess(
    project: str,
    matches: tuple[str, ...] | list[str] = (),
    settings: dict[str, dict[str, JsonValue]] | None = None,
    retry: bool = False,
    dask: str | None = None,
    workers: int | None = None,
    time_limits: dict[str, float] | None = None,
) -> dict[str, str]:
    """Run every match of a project with stale results; return each match's state.

    Nothing is started if nothing is stale. A match that waits for review is no failure; its run
    continues when this flow is called again after the verdict.

    Args:
        project: folder or URL of the store.
        matches: ids of registered matches; none = all.
        settings: stage to settings that override those of each match's latest run.
        retry: retry failed units, even without an edit.
        dask: address of a running Dask scheduler; None starts workers on this machine.
        workers: number of worker processes on this machine; None = one per core.
        time_limits: stage to the time limit of a unit [min], if not the default.

    Raises:
        UnprocessedError: some matches failed or are partial; the others are done.
    """
    request = RunRequest(settings or {}, dask=dask, workers=workers, time_limits=time_limits or {})
    found = reprocess_matches(Store.open(project), tuple(matches), request, retry=retry)
    unprocessed = [
        f"{each.match_id} is {each.state}" + (f": {each.problem}" if each.problem else "")
        for each in found
        if each.state in ("failed", "partial")
    ]
    if unprocessed:
        raise UnprocessedError("; ".join(unprocessed))
    return {each.match_id: each.state for each in found}
