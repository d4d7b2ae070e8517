"""Task of many small units of a stage, one after another: Prefect costs each of them less then."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable

from prefect import task

from data_contracts.work import Work
from tasks.unit import RETRIES, RETRY_SECONDS, may_pass
from worldpose.store import Store


@task(task_run_name="{name}", persist_result=False)
def batch(name: str, work: list[str]) -> list[Exception | None]:
    """Has each unit computed and published as its own task would; gives what each failed of.

    Begun again after its worker was killed, it goes on with the first unit that has no result.

    Args:
        name: as the dashboard shows it.
        work: units of one stage, as JSON: Prefect looks through whatever else it is given.
    """
    units = [Work.model_validate_json(each) for each in work]
    stage = units[0].recipe.stage
    compute = getattr(importlib.import_module(f"tasks.{stage}"), stage).fn
    return [_failure(compute, each) for each in units]


def _failure(compute: Callable[[Work], str], work: Work) -> Exception | None:
    recipe = work.recipe
    if Store.open(work.project).has(recipe.match_id, recipe.stage, recipe.unit, work.key):
        return None
    for _ in range(RETRIES):
        try:
            compute(work)
        except Exception as failure:
            if not may_pass(failure):
                return failure
            time.sleep(RETRY_SECONDS)
        else:
            return None
    try:
        compute(work)
    except Exception as failure:
        return failure
    return None
