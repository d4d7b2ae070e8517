"""Results that a run starts from: earlier stages, and the previous iteration."""

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
    """Results that exist before a run's first stage.

    Attributes:
        results: `stage/unit` to result key, for the stages before.
        iteration: iteration number of the run, from 1.
        before: `stage/unit` to result key of the previous iteration; None in the first.
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
    """Return the results that a run of `stages` starts from.

    A run from the method's first stage uses the previous iteration with its own settings. Any other
    run continues the latest run: it takes that run's results of earlier stages, stale or not, and
    the previous iteration that they were computed from.

    Args:
        store: the store.
        match: the match.
        stages: stages of the run.
        overrides: settings that differ from their defaults.
        latest: the match's latest run.
        iteration: iteration number, if the run does not continue the latest run.
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
    """Return the latest run's inputs from the previous iteration, read from its recipes."""
    before: dict[str, str] = {}
    for stage in METHOD:
        for unit in stage.units(match):
            name = f"{stage.name}/{unit}"
            taken = stage.previous_pass_inputs(match, unit)
            if not taken or name not in latest.results:
                continue
            try:
                manifest = store.manifest(match.match_id, stage.name, unit, latest.results[name])
            except StoreError:  # withdrawn: other recipes name them, else missing
                continue
            inputs = manifest.recipe.inputs
            before |= {each: inputs[each] for each in taken if each in inputs}
    return before
