"""Interface of a stage: its units, their inputs and sources, its settings."""

from __future__ import annotations

from collections.abc import Callable, Container, Hashable
from dataclasses import dataclass, field, replace
from functools import wraps
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from pydantic import JsonValue

from data_contracts.match import Registration
from data_contracts.records import Record
from data_contracts.review import Correction
from flows.layers import Layer, merge_general
from worldpose.ingest.footage import unit_frames
from worldpose.ingest.match_folder import MatchFolder
from worldpose.review.journal import Journal

T = TypeVar("T")


@dataclass(frozen=True)
class Match:
    """A registered match: its folder as validated and corrected, and the digests of its files.

    Attributes:
        corrections: the corrections applied in `folder`.
        stale: corrections that no longer apply, each with the reason.
        layers: layers of settings, the first with the least precedence (`flows.layers`).
    """

    folder: MatchFolder
    registration: Registration
    journal: Journal
    corrections: tuple[Correction, ...] = ()
    stale: tuple[tuple[Correction, str], ...] = ()
    layers: tuple[Layer, ...] = ()
    _kept: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Cache of `once_a_match`."""

    @property
    def match_id(self) -> str:
        """The match's id."""
        return self.registration.spec.match_id

    @property
    def body_folder(self) -> Path | None:
        """Folder of installed bodies that a layer states; None = the user's."""
        folder = self.once("body_folder", lambda: merge_general(self.layers).body_folder)
        return None if folder is None else Path(folder).expanduser()

    @property
    def has_static_cameras(self) -> bool:
        """Whether match.yaml has static cameras, left out or not."""
        return bool(self.registration.spec.static_cameras)

    @property
    def pitch_source(self) -> JsonValue:
        """The pitch, as recipes list it; None without one."""
        pitch = self.folder.pitch
        return None if pitch is None else pitch.model_dump(mode="json")

    def file_sources(self, name: str, file: Path | None) -> dict[str, JsonValue]:
        """Return path and digest of a file of the match folder, as recipes list them."""
        path = None if file is None else file.relative_to(self.folder.folder).as_posix()
        digest = None if path is None else self.registration.digest_of(path)
        return {name: path, f"{name}_sha256": digest}

    def frame_sources(self, unit: str) -> dict[str, JsonValue]:
        """Return how the frames of a camera's or clip's video map to match time."""
        frames = unit_frames(self.folder.spec, unit)
        return {
            "first_frame": frames.first,
            "frame_count": frames.count,
            "offset_frames": frames.clock[0],
            "rate": frames.clock[1],
        }

    def without(self, cameras: Container[str]) -> Match:
        """Return the match without these static cameras; see `flows.left_out`."""
        spec = self.folder.spec
        names = tuple(each.id for each in spec.static_cameras if each.id in cameras)
        if not names:
            return self
        left = tuple(each for each in spec.cameras if each.id not in names)
        fewer = spec.model_copy(update={"cameras": left})
        name = ("without", *names)
        return self.once(name, lambda: replace(self, folder=replace(self.folder, spec=fewer)))

    def at_hand(self) -> Match:
        """Return the match without the videos that are gone, whose results a report still shows."""
        there = {name: file for name, file in self.folder.videos.items() if file.exists()}
        return replace(self, folder=replace(self.folder, videos=there))

    def once(self, name: Hashable, find: Callable[[], T]) -> T:
        """Return the cached result of `find`, which is called on the first request for `name`."""
        if name not in self._kept:
            self._kept[name] = find()
        return cast("T", self._kept[name])


def once_a_match(table: Callable[[Match], T]) -> Callable[[Match], T]:
    """Cache a table per match, because planning needs the table for every unit.

    Hundreds of clips of many cameras make thousands of units. Building the table for each unit
    again has cubic cost.
    """

    @wraps(table)
    def once(match: Match) -> T:
        return match.once(table, lambda: table(match))

    return once


@dataclass(frozen=True)
class Stage:
    """One stage of the method.

    Attributes:
        name: the one name of this stage, and of its task.
        settings: the record of its settings; by default it has none.
        units: names of the pieces that are computed, retried and stored separately.
        inputs: returns the `stage/unit` names of a unit's input results.
        sources: returns all data of the match folder that a unit's result depends on.
        previous_pass_inputs: returns a unit's further inputs from the previous iteration.
        late_inputs: returns a unit's further inputs from its own iteration, from the second on.
        external_inputs: returns the digests of the external files that its settings name, for a
            match.
        worker_tag: tag of the workers that compute it, if the cluster has any.
        leaves_out: whether its results can leave static cameras out of all later stages.
        min_cameras: static cameras that it needs after some are left out.
        needs_static_cameras: whether it has no units in a match of broadcast cameras alone.
        task_file: the stage in whose file of `tasks` its task is, if it has no file of its own.
    """

    name: str
    about: str
    units: Callable[[Match], tuple[str, ...]]
    sources: Callable[[Match, str], dict[str, JsonValue]]
    inputs: Callable[[Match, str], tuple[str, ...]] = lambda match, unit: ()
    settings: type[Record] = Record
    previous_pass_inputs: Callable[[Match, str], tuple[str, ...]] = lambda match, unit: ()
    late_inputs: Callable[[Match, str], tuple[str, ...]] = lambda match, unit: ()
    first_pass: Literal[1, 2] = 1
    external_inputs: Callable[[Match, Any], dict[str, JsonValue]] = lambda match, settings: {}
    worker_tag: str | None = None
    leaves_out: bool = False
    min_cameras: int = 0
    needs_static_cameras: bool = False
    task_file: str | None = None

    @property
    def task_module(self) -> str:
        """Module with its task; the key of a result depends on the code that this imports."""
        return f"tasks.{self.task_file or self.name}"
