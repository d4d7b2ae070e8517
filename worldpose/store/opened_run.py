"""A run's results as labelled arrays."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from data_contracts.run import RunRecord
from worldpose.errors import UsageError
from worldpose.store.runs import LATEST
from worldpose.store.store import Store

if TYPE_CHECKING:
    import xarray as xr


class Run(Mapping[str, "xr.Dataset"]):
    """Results of one run: `run["triangulation/clip"].joints`.

    Each is opened on first access, and its values are read on access.
    """

    def __init__(self, store: Store, record: RunRecord, *, complete: bool = False) -> None:
        self.record = record
        """Record of the run: results, settings, metrics, versions, times."""
        self._store = store
        self._complete = complete
        self._opened: dict[str, xr.Dataset] = {}

    def __getitem__(self, name: str) -> xr.Dataset:
        if name not in self.record.results:
            failures = {failure.unit: failure for failure in self.record.failed}
            if name in failures:
                why = f"it failed with {failures[name].error}: {failures[name].message}"
            elif name in self.record.blocked and self.record.waiting:
                why = f"{len(self.record.waiting)} results before it wait for review"
            else:
                why = f"the run has {', '.join(self) or 'no results'}"
            raise KeyError(f"run {self.record.run_id} has no result of {name!r}: {why}")
        if name not in self._opened:
            stage, _, unit = name.partition("/")
            result = self._store.open_result(
                self.record.match_id, stage, unit, self.record.results[name]
            )
            if self._complete:
                self._require_all_arrays(name, stage, result)
            self._opened[name] = result
        return self._opened[name]

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self.record.results))

    def __len__(self) -> int:
        return len(self.record.results)

    def __contains__(self, name: object) -> bool:
        return name in self.record.results

    def _require_all_arrays(self, name: str, stage: str, result: xr.Dataset) -> None:
        from data_contracts.schemas import LAYOUTS  # imported here: it imports every record class

        (layout,) = (each for each in LAYOUTS if each.stage == stage)
        written = {*(array.name for array in layout.arrays), *layout.attributes}
        absent = sorted(written - set(layout.optional) - {*result.variables, *result.attrs})
        if absent:
            raise UsageError(
                f"run {self.record.run_id} of match {self.record.match_id}: {name}",
                expected="a result of this version of worldpose",
                found=f"one of an earlier version, without {', '.join(absent)}",
                todo=f"Compute it anew: worldpose run {self.record.match_id}.",
            )

    def __repr__(self) -> str:
        record = self.record
        title = f"Run {record.run_id} of match {record.match_id}: {record.state}"
        return "\n".join(
            [
                f"{title}, finished {record.finished_at:%Y-%m-%d %H:%M} UTC, {self._store.url}",
                *(f"  {name}  {record.results[name][:12]}" for name in self),
                *(f"  {failure.unit}  failed: {failure.error}" for failure in record.failed),
            ]
        )


def open_run(
    project: str | os.PathLike[str], match: str, run: str = LATEST, *, complete: bool = False
) -> Run:
    """Open a match run's results as labelled arrays (xarray), metres and pixels, world frame.

    Args:
        project: the project's folder or `s3://bucket/prefix`.
        match: the match's id.
        run: the run's number, such as `0003`, or `latest`.
        complete: refuse, on opening, a result that an earlier version of worldpose computed without
            some array of this version.

    Raises:
        InputError: there is no such project, match or run.
        CorruptionError: stored bytes differ from the published ones.
    """
    store = Store.open(project)
    return Run(store, store.run(match, run), complete=complete)
