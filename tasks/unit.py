"""Common behaviour of all units' tasks: dashboard name, retries, verified inputs."""

from __future__ import annotations

import ctypes
import functools
import logging
import platform
import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from prefect import Task, task
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import TaskRunContext
from prefect.events.clients import PrefectEventsClient
from prefect.events.worker import EventsWorker
from prefect.logging.handlers import APILogWorker
from prefect.settings import PREFECT_API_URL

from data_contracts.pitch import PitchSpec
from data_contracts.records import Record
from data_contracts.run import ResultManifest
from data_contracts.work import Recipe, Work
from tasks.watchdog import kill_on_timeout
from worldpose.errors import (
    CorruptionError,
    InputError,
    InternalError,
    NondeterminismError,
    StoreError,
    WorldposeError,
    require_memory,
)
from worldpose.ingest.registration import digest_of_files
from worldpose.pitch.template import PitchTemplate
from worldpose.sources import code_version
from worldpose.store.recipes import libraries, recipe_key
from worldpose.store.store import Store
from worldpose.store.writer import ResultWriter

Settings = TypeVar("Settings", bound=Record)
RETRIES: Final = 2
RETRY_SECONDS: Final = 1.0
"""Before a retry of a temporary failure."""
MAX_SERVERS: Final = 4
"""Prefect servers to which a worker stays connected."""
RECONNECTIONS: Final = 3
"""Attempts to connect again for each event; events that fail wait for the next attempt, after 30 s.
Prefect's 10, with a second in between, keep the events of an ended server for minutes."""

MMAP_BYTES: Final = 32 << 20
"""Arrays from this size on get pages of their own and return them when freed [byte]."""
TRIM_BYTES: Final = 64 << 20
"""Freed memory that a process keeps for its next arrays [byte]."""
_MMAP_THRESHOLD: Final = -3
_TRIM_THRESHOLD: Final = -1
"""M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of glibc's mallopt."""

_senders: OrderedDict[str, tuple[APILogWorker, EventsWorker]] = OrderedDict()
"""Senders of this process's log lines and events, by server, the least recently used first."""


class Spool:
    """Arrays by name in a scratch folder, extended by every added chunk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._form: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def add(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Append a chunk; frames are the first dimension."""
        for name, values in arrays.items():
            frames = self._form[name][1][0] if name in self._form else 0
            with (self._folder / name).open("ab") as file:
                np.ascontiguousarray(values).tofile(file)
            self._form[name] = (values.dtype, (frames + len(values), *values.shape[1:]))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all added data, read from disk on access."""
        return {
            name: np.memmap(self._folder / name, dtype, "r", shape=shape)
            if np.prod(shape)
            else np.empty(shape, dtype)
            for name, (dtype, shape) in self._form.items()
        }


@dataclass(frozen=True)
class UnitInputs:
    """What one unit is computed from."""

    store: Store
    work: Work

    @property
    def recipe(self) -> Recipe:
        """All that the result depends on."""
        return self.work.recipe

    @property
    def unit(self) -> str:
        """Name of the unit in its stage."""
        return self.recipe.unit

    @property
    def sources(self) -> dict[str, Any]:
        """Input from the match folder."""
        return self.recipe.sources

    @property
    def frames(self) -> NDArray[np.int64]:
        """(frames,) match frames of the unit's clip."""
        first = self.sources["first_frame"]
        return np.arange(first, first + self.sources["frame_count"])

    @property
    def pitch(self) -> PitchTemplate | None:
        """The pitch of the match; None without one."""
        pitch = self.sources["pitch"]
        return None if pitch is None else PitchTemplate.from_spec(PitchSpec.model_validate(pitch))

    def __contains__(self, name: object) -> bool:
        """Return whether `stage/unit` is an input."""
        return name in self.recipe.inputs

    def open(self, name: str) -> xr.Dataset:
        """Open the input `stage/unit`, or StoreError; each byte is verified by its manifest."""
        stage, _, unit = name.partition("/")
        return self.store.open_result(self.recipe.match_id, stage, unit, self.recipe.inputs[name])

    def open_first(self, *names: str) -> xr.Dataset:
        """Open the first of these results that is an input."""
        return self.open(next(name for name in names if name in self))

    def made_from(self, name: str) -> UnitInputs:
        """Return what the input `stage/unit` was computed from."""
        work = self.work.model_copy(update={"recipe": self.manifest(name).recipe})
        return UnitInputs(self.store, work)

    def manifest(self, name: str) -> ResultManifest:
        """Return the manifest of the input `stage/unit`."""
        stage, _, unit = name.partition("/")
        return self.store.manifest(self.recipe.match_id, stage, unit, self.recipe.inputs[name])

    def settings(self, kind: type[Settings]) -> Settings:
        """Return the settings that it is computed with."""
        return kind.model_validate(self.recipe.settings)

    def open_uncorrected(self, corrections: str) -> tuple[xr.Dataset, ResultManifest] | None:
        """Return the published result of the same recipe without `corrections`; None without one.

        That source has people's corrections. A new computation would give the same bytes.
        """
        recipe = self.recipe
        sources = {name: each for name, each in recipe.sources.items() if name != corrections}
        key = recipe_key(recipe.model_copy(update={"sources": sources}))
        place = (recipe.match_id, recipe.stage, recipe.unit, key)
        if not self.store.has(*place):
            return None
        return self.store.open_result(*place), self.store.manifest(*place)

    @contextmanager
    def open_spool(self) -> Iterator[Spool]:
        """Yield a temporary spool next to the results in progress, where there is disk space."""
        folder = self.store.blobs.create_staging()
        try:
            yield Spool(folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def file(self, name: str) -> Path:
        """Return the file or folder of the match folder that a source names."""
        return Path(self.work.folder, self.sources[name])

    def require_registered(self, name: str) -> None:
        """Refuse the content of `file(name)` as `require_registered`."""
        require_registered(self.file(name), self.sources[f"{name}_sha256"])


def unit_task(compute: Callable[[UnitInputs, ResultWriter], None]) -> Task[[Work], str]:
    """Turn a function that writes the result of one unit into a task that publishes it.

    The task takes the work order, and returns the key of the result.
    """

    def run_checked(work: Work) -> str:
        # A log line that Prefect's server rejects (a full disk) is not output of a worker.
        logging.raiseExceptions = False
        send_to_own_server()
        keep_freed_memory()
        require_same_code(work, compute.__module__)
        with kill_on_timeout(work):
            try:
                store = Store.open(work.project)
                with store.publish(work) as result:
                    compute(UnitInputs(store, work), result)
                return work.key
            except WorldposeError:
                raise
            except Exception as error:
                require_memory(error, work.recipe.name)
                if isinstance(error, OSError):
                    raise
                # A bug must not look like a fault of the match.
                raise InternalError.wrap(work.recipe.name, error) from error

    for name in ("__module__", "__name__", "__qualname__", "__doc__"):
        setattr(run_checked, name, getattr(compute, name))
    return task(
        task_run_name="{work.recipe.stage} {work.recipe.unit}",
        retries=RETRIES,
        retry_delay_seconds=RETRY_SECONDS,
        retry_condition_fn=_may_be_retried,
        persist_result=False,
    )(run_checked)


@functools.cache
def keep_freed_memory() -> None:
    """Let this process use freed memory again for its next arrays.

    Dask starts its workers with a trim threshold of 64 KiB, with which every array of more than 128
    KiB is mapped, zeroed page by page, and unmapped: a third of the CPU time of some stages. This
    is what glibc does by default after its first large arrays.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # not glibc
        return
    mallopt(_MMAP_THRESHOLD, MMAP_BYTES)
    mallopt(_TRIM_THRESHOLD, TRIM_BYTES)


def require_same_code(work: Work, module: str) -> None:
    """Refuse to compute with other code than that of the key."""
    recipe = work.recipe
    ours = {**code_version(module), **libraries()}
    theirs = {**recipe.code, **recipe.libraries}
    differing = sorted(name for name in ours | theirs if ours.get(name) != theirs.get(name))
    if differing:
        raise InputError(
            f"worker on {platform.node()}, {recipe.name}",
            expected="the code and libraries that the run was planned with",
            found=f"others in {', '.join(differing)}",
            todo="Install the same worldpose on all workers, restart them, and run again.",
        )


def send_to_own_server() -> None:
    """Send log lines and events of the current task to the server of its run.

    Every run on the command line may have a server of its own. Prefect keeps one sender of log
    lines for each server that a process ever had, and a single sender of events, which continues
    to address the first server: in a worker that stays, lost events and their contexts used 10 MB
    more with each run. Here each server has its senders, and those of the least recently used
    servers end.
    """
    address = PREFECT_API_URL.value()
    if TaskRunContext.get() is None or address is None:
        return
    EventsWorker.set_client_override(
        PrefectEventsClient, api_url=address, reconnection_attempts=RECONNECTIONS
    )
    _senders[address] = APILogWorker.instance(), EventsWorker.instance()
    _senders.move_to_end(address)
    while len(_senders) > MAX_SERVERS:
        for sender in _senders.popitem(last=False)[1]:
            threading.Thread(target=sender.drain, daemon=True).start()  # its server may be gone


def require_registered(path: Path, sha256: str) -> None:
    """Refuse the content of a match file or folder that differs from the registered one.

    Call it after reading, so that it detects changes in between.
    """
    if digest_of_files(path) != sha256:
        raise InputError(
            str(path),
            expected="the file that was registered when the run began",
            found="other content",
            todo="Run again when nothing writes to the match folder.",
        )


def figures_of(report: Record, camera_ids: Sequence[str]) -> dict[str, float]:
    """Return a stage's report as metrics of its result; a value per camera is `metric.camera`."""
    figures: dict[str, float] = {}
    for name, value in report:
        per_camera = isinstance(value, tuple)
        values = zip(camera_ids, value, strict=True) if per_camera else [("", value)]
        for camera_id, number in values:
            if number is not None:
                figures[f"{name}.{camera_id}" if per_camera else name] = float(number)
    return figures


def may_pass(failure: BaseException) -> bool:
    """Return whether a failure can be temporary: of a disk or network, not an input or a bug."""
    lasting = isinstance(failure, CorruptionError | NondeterminismError)
    return isinstance(failure, StoreError | OSError) and not lasting


def _may_be_retried(task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    failure = state.result(raise_on_failure=False)
    return isinstance(failure, BaseException) and may_pass(failure)
