"""What every unit's task has in common: its name in the dashboard, retries, verified inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import xarray as xr
from prefect import Task, task
from prefect.client.schemas.objects import State, TaskRun

from data_contracts.records import Record
from data_contracts.run import Work
from worldpose.errors import WorldposeError
from worldpose.store import Store


def _worth_retrying(task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Whether a failure may pass: the same input fails the same way, a full disk may not."""
    failure = state.result(raise_on_failure=False)
    return not isinstance(failure, WorldposeError)


unit_task = task(
    task_run_name="{work.recipe.stage} {work.recipe.unit}",
    retries=2,
    retry_delay_seconds=1,
    retry_condition_fn=_worth_retrying,
    persist_result=False,
)
"""Decorates a function of one `Work` that publishes its result under `work.key`."""


def open_input(store: Store, work: Work, name: str) -> xr.Dataset:
    """A published input of this work; every byte is checked against its manifest when read.

    Args:
        store: the store.
        work: the work under way.
        name: the input as `stage/unit`.

    Raises:
        StoreError: the input is not published.
    """
    stage, _, unit = name.partition("/")
    return store.open_result(work.recipe.match_id, stage, unit, work.recipe.inputs[name])


def figures_of(report: Record, camera_ids: Sequence[str]) -> dict[str, float]:
    """A stage's report as figures of its result; a value a camera is named `figure.camera`."""
    figures: dict[str, float] = {}
    for name, value in report:
        per_camera = isinstance(value, tuple)
        values = zip(camera_ids, value, strict=True) if per_camera else [("", value)]
        for camera_id, number in values:
            if number is not None:
                figures[f"{name}.{camera_id}" if per_camera else name] = float(number)
    return figures
