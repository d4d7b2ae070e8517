"""Task that computes many small units of a stage, with less Prefect overhead each."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable

from prefect import task

from data_contracts.work import Work
from tasks.unit import RETRIES, RETRY_SECONDS, may_pass
from tasks.watchdog import was_interrupted
from worldpose.compiled import map_in_threads
from worldpose.store.store import Store


@task(task_run_name="{name}", persist_result=False)
def batch(name: str, module: str, work: list[str]) -> list[Exception | None]:
    """Compute and publish each unit like its own task; return the exception of each, or None.

    Two are computed at the same time. After its worker was killed, a retry resumes with the units
    without a result, one by one: only the unit that ended the process may be given up. `module` has
    the task of their stage; the work is JSON, as Prefect inspects parameters of any other type.
    """
    units = [Work.model_validate_json(each) for each in work]
    compute = getattr(importlib.import_module(module), units[0].recipe.stage).fn
    if any(was_interrupted(each) for each in units):
        return [_failure(compute, each) for each in units]
    return list(map_in_threads(lambda each: _failure(compute, each), units))


def _failure(compute: Callable[[Work], str], work: Work) -> Exception | None:
    recipe = work.recipe
    if Store.open(work.project).has(recipe.match_id, recipe.stage, recipe.unit, work.key):
        return None
    failures = 0
    while True:
        try:
            compute(work)
        except Exception as failure:
            failures += 1
            if failures > RETRIES or not may_pass(failure):
                return failure
            time.sleep(RETRY_SECONDS)
        else:
            return None
