"""Exports that settings ask for after every run of a match."""

from __future__ import annotations

from pathlib import Path

from data_contracts.run import RunRecord
from flows.layers import merge_general
from flows.progress import reporter
from flows.stage import Match
from worldpose.errors import InputError
from worldpose.store.store import Run, Store


def export_after_run(store: Store, match: Match, record: RunRecord) -> list[Path]:
    """Write the exports that the layers of a match state; return their files.

    Only a run that has results of its last stage is exported; if it has no people, only in formats
    of cameras. Files of an earlier run of the match are replaced.
    """
    settings = merge_general(match.layers)
    if not settings.exports or record.state not in ("complete", "partial"):
        return []
    from flows.results.best_results import Origin, find_clips  # late: few runs are exported
    from flows.results.export import export
    from flows.results.possible_exports import impossible_exports

    origin, forms = Origin(Run(store, record), match.registration), list(settings.exports)
    if not find_clips(record):
        lacking = impossible_exports(origin.run, origin.spec)
        forms = [form for form in settings.exports if form not in lacking]
        left = [form for form in settings.exports if form in lacking]
        if left:
            reporter().say(f"run {record.run_id} has no people yet: no export of {', '.join(left)}")
        if not forms:
            return []
    folder = settings.exports_folder or f"{store.url}/exports"
    if "://" in folder:
        raise InputError(
            "exports_folder",
            expected="a folder on this machine: the project is in object storage",
            found="none",
            todo="Name one: worldpose settings --set exports_folder=/data/exports.",
        )
    place = Path(folder).expanduser() / match.match_id
    return export(origin, forms, place)
