"""The flows as deployments run them: with Dask workers, and with parameters that are plain JSON."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.artifacts import create_table_artifact
from prefect.deployments import run_deployment
from prefect_dask import DaskTaskRunner

from data_contracts.finetune import NetKind
from data_contracts.operations import Arrival
from flows.match import process_match
from flows.operations.arrivals import take_in
from flows.operations.plan import ServePlan
from flows.prefect_environment import served_cluster
from flows.stage import Match
from worldpose.store import Store

LOG = logging.getLogger("worldpose.operations")

match = process_match.with_options(task_runner=DaskTaskRunner(**served_cluster()))
"""Process one match; suspended while its results wait for people."""


@flow(name="ingest", flow_run_name="inbox", validate_parameters=False)
def ingest(plan: dict[str, Any]) -> list[str]:
    """Take in every match that has arrived whole, and give each its run; returns their ids.

    Args:
        plan: a `ServePlan`.
    """
    LOG.setLevel(logging.INFO)
    served = ServePlan.model_validate(plan)

    def begin(opened: Match, arrival: Arrival) -> str:
        return _begin(served, opened, arrival)

    decided = take_in(
        Store.create(served.project),
        served.state_folder,
        served.inbox,
        served.quiet_seconds,
        begin,
    )
    for arrival in decided:
        LOG.info("%s: %s %s", arrival.name, arrival.state, arrival.reason)
    if decided:
        create_table_artifact(
            key="arrivals",
            table=[
                {
                    "arrival": each.name,
                    "state": each.state,
                    "match": each.match_id or "",
                    "why": each.reason,
                }
                for each in decided
            ],
            description=f"What arrived in {served.inbox}",
        )
    return [arrival.match_id for arrival in decided if arrival.match_id]


def _begin(plan: ServePlan, opened: Match, arrival: Arrival) -> str:
    run = run_deployment(
        plan.match_deployment,
        parameters={"match_id": opened.match_id},
        flow_run_name=opened.match_id,
        timeout=0,
        as_subflow=False,
        tags=[arrival.priority],
        # Called again after a kill, or for a folder that moved, it gives the run that is there.
        idempotency_key=f"arrival-{opened.registration.identity}",
        work_queue_name=arrival.priority,
    )
    return str(run.id)


@flow(name="finetune", validate_parameters=False)
def finetune(
    project: str,
    annotations: str,
    pictures: str | None = None,
    nets: Sequence[NetKind] = ("people", "keypoints"),
    settings: dict[str, Any] | None = None,
    starts: dict[NetKind, str] | None = None,
) -> list[str]:
    """Train the embedded nets on reviewed labels; returns the files of their new versions.

    Args:
        project: folder of the store, which keeps the versions.
        annotations: file of COCO keypoints.
        pictures: the folder of their pictures; that of the annotations if None.
        nets: which.
        settings: of the training, where not their defaults.
        starts: net to the weights to begin from, where not the shipped ones.
    """
    from flows.finetune import FOLDER, fine_tune_nets  # late: torch takes seconds to import
    from worldpose.training import FineTuningSettings

    versions = fine_tune_nets.fn(  # as this flow, not as one within it
        Path(annotations),
        None if pictures is None else Path(pictures),
        Path(project) / FOLDER,
        nets,
        FineTuningSettings.model_validate(settings or {}),
        {kind: Path(file) for kind, file in (starts or {}).items()},
    )
    return [version.file for version in versions]
