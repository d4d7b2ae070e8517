"""What a run goes on from: the stages before its own, and the iteration before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from data_contracts.run import RunRecord
from flows.method import METHOD
from flows.planning import results_before
from flows.settings import Overrides
from flows.stage import Match, Stage
from worldpose.errors import StoreError
from worldpose.store import Store


@dataclass(frozen=True)
class Basis:
    """What is there before a run's first stage.

    Attributes:
        results: `stage/unit` to key of the stages before.
        iteration: which pass over the method the run is of, from 1.
        before: `stage/unit` to key of the pass before; None in the first.
    """

    results: Mapping[str, str]
    iteration: int
    before: Mapping[str, str] | None


def basis_of(
    store: Store,
    match: Match,
    stages: tuple[Stage, ...],
    overrides: Overrides,
    latest: RunRecord | None,
    iteration: int,
) -> Basis:
    """What a run of `stages` goes on from.

    A run of the method from its first stage has the pass before it, with its own settings. Any
    other goes on with the latest run: the results of the stages before stand, stale or not, of
    whichever pass they are, and so does what that pass was made of.

    Args:
        store: the store.
        match: the match.
        stages: those of the run.
        overrides: its settings that differ from their defaults.
        latest: the match's latest run.
        iteration: which pass it is, if it goes on with no other.
    """
    if stages[0] is METHOD[0]:
        return Basis({}, iteration, results_before(store, match, overrides, iteration))
    if latest is None:
        return Basis({}, 1, None)
    earlier = {stage.name for stage in METHOD[: METHOD.index(stages[0])]}
    standing = {
        name: key for name, key in latest.results.items() if name.partition("/")[0] in earlier
    }
    before = _made_of(store, match, latest) if latest.iteration > 1 else None
    return Basis(standing, latest.iteration, before)


def _made_of(store: Store, match: Match, latest: RunRecord) -> dict[str, str]:
    """What the latest run took from the pass before it, as its results' recipes say."""
    before: dict[str, str] = {}
    for stage in METHOD:
        for unit in stage.units(match):
            name = f"{stage.name}/{unit}"
            taken = stage.previous_pass_inputs(match, unit)
            if not taken or name not in latest.results:
                continue
            try:
                manifest = store.manifest(match.match_id, stage.name, unit, latest.results[name])
            except StoreError:  # withdrawn: the others tell, or what it was made of is missed
                continue
            inputs = manifest.recipe.inputs
            before |= {each: inputs[each] for each in taken if each in inputs}
    return before
