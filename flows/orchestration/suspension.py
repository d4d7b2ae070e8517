"""Suspension of a deployment's run until review: Prefect suspends it, its process ends.

The store's journal is authoritative; Prefect only keeps the run until it is resumed from the
command line or in Prefect's own form. A resumed run restarts and finds all its results.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Final, Literal

from prefect.flow_runs import suspend_flow_run
from prefect.input import RunInput
from pydantic import Field

from data_contracts.review import ReviewDecision
from data_contracts.run import WaitingUnit
from flows.orchestration.prefect_api import PrefectApi, of_types
from flows.orchestration.prefect_environment import CLIENT_LOGIN
from flows.review.metric_words import all_reasons
from worldpose.errors import WorldposeError
from worldpose.review.journal import Journal, say
from worldpose.store.documents import canonical_json, digest
from worldpose.store.store import Store, open_blobs

PATIENCE: Final = timedelta(days=90)
"""Prefect cannot resume a run after a longer suspension; a new run continues equally well."""
OPEN: Final = ("PAUSED", "RUNNING")
SUSPENDING: Final = 10.0
"""Maximum time from a run's last look at verdicts until it is suspended [s]."""


class Verdict(RunInput):
    """Input that resumes a run. The verdict has no default, so that an empty form is refused."""

    verdict: Literal["approve", "reject", "recorded"]
    """On all pending reviews; `recorded`: decided one by one, as with `worldpose review`."""
    who: str = Field(min_length=1)
    """Name of the reviewer."""
    why: str = ""
    """The reviewer's comment."""


def take_verdict(store: Store, match_id: str, waiting: Sequence[WaitingUnit]) -> None:
    """Suspend this flow run, or record the verdict that it was resumed with.

    Prefect identifies the question by a key derived from the waiting results: after a resume the
    same key returns the answer, and other results form another question. The waiting units are in
    the journal already. WorldposeError if it is resumed with `recorded` though nothing was decided;
    prefect.exceptions.Pause, which ends the process, if it is not answered yet.
    """
    asked = sorted(unit.request for unit in waiting)
    lines = [f"- `{unit.request}`: {all_reasons(unit.reasons)}" for unit in waiting]
    text = "\n".join([f"{len(waiting)} results of {match_id} wait for review:", *lines])
    answer = suspend_flow_run(
        wait_for_input=Verdict.with_initial_data(description=text),
        key=f"review-{digest(canonical_json(asked))[:16]}",  # the same for the same results
        timeout=int(PATIENCE.total_seconds()),
    )
    if answer.verdict == "recorded":
        raise WorldposeError(
            f"{match_id} was resumed with the verdict `recorded`, but {len(waiting)} results have "
            f"none: {waiting[0].request} and others. Decide with `worldpose review approve` or "
            "`reject`, and run again."
        )
    verdict: Literal["approve", "reject"] = answer.verdict

    def decisions(journal: Journal) -> list[ReviewDecision]:
        # The command line can have recorded a verdict between the resume and now.
        decided = {
            record.request for record in journal.questions if isinstance(record, ReviewDecision)
        }
        return [
            ReviewDecision(
                match_id=match_id,
                request=unit.request,
                verdict=verdict,
                who=answer.who,
                why=answer.why,
                decided_at=datetime.now(UTC),
            )
            for unit in waiting
            if unit.request not in decided
        ]

    say(store, match_id, decisions)


def resume_suspended(project: str, match_id: str) -> list[str]:
    """Resume the suspended runs of a match after its reviews are decided; return their names.

    WorldposeError if Prefect does not answer, or refuses.
    """
    api = os.environ["PREFECT_API_URL"].rstrip("/")
    prefect, deadline = PrefectApi(api, os.environ.get(CLIENT_LOGIN)), time.monotonic() + SUSPENDING
    resumed: list[str] = []
    while True:
        found = [
            run
            for run in prefect.list_all("flow_runs", flow_runs={"state": of_types(*OPEN)})
            if run["deployment_id"] is not None  # else no worker would take it up
            and run["parameters"].get("match_id") == match_id
            and open_blobs(str(run["parameters"].get("project"))).url == project
        ]
        refused = ""
        for run in found:
            if run["state_type"] == "PAUSED":
                given = {"run_input": {"verdict": "recorded", "who": "worldpose review"}}
                answer = prefect.ask(f"/flow_runs/{run['id']}/resume", given)
                if answer["status"] == "ACCEPT":
                    resumed.append(run["name"])
                else:
                    refused = f"{run['name']}: {answer['details'].get('reason')}"
        # A run at work can be about to ask, and one that asks has not yet said what.
        is_suspending = refused or any(run["state_type"] == "RUNNING" for run in found)
        if resumed or not is_suspending or time.monotonic() > deadline:
            break
        time.sleep(1.0)
    if refused:
        raise WorldposeError(
            f"Prefect does not resume {refused}. Start a new run of {match_id}: it continues "
            "equally well."
        )
    return resumed
