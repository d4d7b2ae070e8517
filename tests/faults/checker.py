"""Checks that a store is correct after its writers were killed."""

from collections import Counter
from datetime import timedelta

from store_comparison import compare_stores

from worldpose.store.garbage import collect, plan_gc
from worldpose.store.integrity import verify
from worldpose.store.store import Store


def problems_of(project, undisturbed):
    """Return one line per difference between a project and an undisturbed one.

    Both must have the same matches, results, bytes and latest records. Nothing may be damaged, no
    unit computed for two records, and `gc` must clear everything that dead writers left.
    """
    store = Store.open(str(project))
    problems = [*differences(project, undisturbed), *doubled(store)]
    for match in store.matches():
        dead = [f"{match}/{each.run_id}" for each in store.unfinished_runs(match)]
        collect(store, plan_gc(store, forget=dead, older_than=timedelta(0)))
    problems += [f"{each.path}: cannot be cleared away" for each in store.blobs.staged_entries()]
    return problems + [f"cleared: {each}" for each in differences(project, undisturbed)]


def differences(project, undisturbed):
    """Yield damages, and differences from another project."""
    store, reference = Store.open(str(project)), Store.open(str(undisturbed))
    damage = [f"{each.path}: {each.problem}" for each in verify(store)]
    return compare_stores(store, reference) + damage


def doubled(store):
    """Units that two runs of a match say they have computed."""
    for match in store.matches():
        records = [store.run(match, run) for run in store.runs(match)]
        computed = Counter(
            (unit, record.results[unit]) for record in records for unit in record.executed
        )
        for (unit, key), times in computed.items():
            if times > 1:
                yield f"{match}/{unit}: computed {times} times as {key[:12]}"


def half_written(project):
    """Return damages and incomplete runs of a project that is damaged or in use."""
    if not (project / "project.json").exists():
        return []
    store = Store.open(str(project))
    records = [store.run(match, run) for match in store.matches() for run in store.runs(match)]
    unfinished = [f"{each.match_id}/{each.run_id}" for each in records if each.state != "complete"]
    return [*(f"{each.path}: {each.problem}" for each in verify(store)), *unfinished]
