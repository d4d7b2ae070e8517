"""The flow that a schedule or an event starts: whatever an edit has touched is made current."""

from __future__ import annotations

from prefect import flow
from pydantic import JsonValue

from flows.reprocessing import reprocess_matches
from flows.running import RunRequest
from worldpose.errors import WorldposeError
from worldpose.store import Store


class UnprocessedError(WorldposeError):
    """Some matches could not be made current; the others are."""


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
    """Runs every match of a project that an edit has touched; gives each match's state.

    Nothing is started where nothing was touched. A match that waits for people is no failure; its
    run goes on when this flow comes again after their verdict.

    Args:
        project: folder or URL of the store.
        matches: ids of registered matches; none = all.
        settings: stage to settings to ask for beside those of each match's latest run.
        retry: try again what failed, though nothing was edited.
        dask: address of a running Dask scheduler; None starts workers on this machine.
        workers: number of worker processes on this machine; None = one a core.
        time_limits: stage to the minutes that a unit may be at work, where not as long as all.

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
