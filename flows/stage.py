"""What a stage is to the factory: its units, what each is made from, its settings."""

from __future__ import annotations

from collections.abc import Callable, Container, Hashable
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, Literal, TypeVar, cast

from pydantic import JsonValue

from data_contracts.match import Registration
from data_contracts.records import Record
from data_contracts.review import Correction
from worldpose.ingest import MatchFolder
from worldpose.review import Journal

T = TypeVar("T")


@dataclass(frozen=True)
class Match:
    """A registered match: its folder as validated and corrected, and the digests of its files.

    Attributes:
        folder: what it holds, with people's corrections.
        registration: what the project knows of it.
        journal: what people said of it.
        corrections: those that are in `folder`.
        stale: those that no longer apply, each with the reason.
    """

    folder: MatchFolder
    registration: Registration
    journal: Journal
    corrections: tuple[Correction, ...] = ()
    stale: tuple[tuple[Correction, str], ...] = ()
    _kept: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What `once_a_match` has found out of it."""

    @property
    def match_id(self) -> str:
        """The match's id."""
        return self.registration.spec.match_id

    def without(self, cameras: Container[str]) -> Match:
        """The match as if it did not have these static cameras; see `flows.left_out`."""
        spec = self.folder.spec
        names = tuple(each.id for each in spec.static_cameras if each.id in cameras)
        if not names:
            return self
        left = tuple(each for each in spec.cameras if each.id not in names)
        fewer = spec.model_copy(update={"cameras": left})
        name = ("without", *names)
        return self.once(name, lambda: replace(self, folder=replace(self.folder, spec=fewer)))

    def once(self, name: Hashable, find: Callable[[], T]) -> T:
        """What `find` gives, which is called the first time that `name` is asked for."""
        if name not in self._kept:
            self._kept[name] = find()
        return cast("T", self._kept[name])


def once_a_match(table: Callable[[Match], T]) -> Callable[[Match], T]:
    """Work out a table of a match once, though planning asks for it at every unit.

    Hundreds of clips of many cameras are thousands of units: what looks through all of them for
    each one grows with their cube.
    """

    @wraps(table)
    def kept(match: Match) -> T:
        return match.once(table, lambda: table(match))

    return kept


def _nothing(settings: Record) -> dict[str, JsonValue]:
    return {}


def _no_results(match: Match, unit: str) -> tuple[str, ...]:
    return ()


@dataclass(frozen=True)
class Stage:
    """One step of the method; its task is the function of the same name in `tasks`.

    Attributes:
        name: the one word for this stage in flows/, tasks/, worldpose/ and data_contracts/.
        about: what a person reads in progress lines.
        settings: the record of its settings.
        units: names of the pieces that are computed, retried and stored on their own.
        inputs: for a unit, the `stage/unit` names of the results it is made from.
        sources: for a unit, everything the match folder contributes to its result.
        previous_pass_inputs: for a unit, the inputs from the iteration before.
        late_inputs: for a unit, further inputs from its own iteration, from the second one on.
        first_pass: the first iteration in which the stage runs.
        external_inputs: digests of the files outside the match that its settings name.
        worker_tag: tag of the workers that compute it, if the cluster has such.
        leaves_out: its results may leave static cameras out of all later stages.
        min_cameras: static cameras that it needs once some are left out.
    """

    name: str
    about: str
    settings: type[Record]
    units: Callable[[Match], tuple[str, ...]]
    inputs: Callable[[Match, str], tuple[str, ...]]
    sources: Callable[[Match, str], dict[str, JsonValue]]
    previous_pass_inputs: Callable[[Match, str], tuple[str, ...]] = _no_results
    late_inputs: Callable[[Match, str], tuple[str, ...]] = _no_results
    first_pass: Literal[1, 2] = 1
    external_inputs: Callable[[Any], dict[str, JsonValue]] = _nothing
    worker_tag: str | None = None
    leaves_out: bool = False
    min_cameras: int = 0
