"""Schedules of deployments: those of `worldpose serve --schedule`.

People also make schedules in Prefect's dashboard and through its API; nothing here changes those.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from flows.orchestration.prefect_api import PrefectApi
from flows.service.plan import Schedule
from worldpose.errors import UsageError

SCHEDULED: Final = ("ingest", "reprocess")
"""Flows that run without parameters of a person."""
SLUG: Final = "serve-schedule"
"""Slug of the schedule of `--schedule` at its deployment; all others are the operator's."""
CRON_FIELDS: Final = 5


def parse_schedules(texts: Iterable[str]) -> dict[str, Schedule]:
    """Return schedules given as `FLOW=CRON`, or `FLOW=CRON TIMEZONE`, by flow.

    Without a time zone, times are those of this machine's zone.

    Raises:
        UsageError: an unknown flow, no valid cron expression, or an unknown time zone.
    """
    found: dict[str, Schedule] = {}
    for text in texts:
        flow, _, given = text.partition("=")
        fields = given.split()
        zone = fields.pop() if len(fields) == CRON_FIELDS + 1 else _local_timezone()
        cron = " ".join(fields)
        problem = _problem(cron, zone) if flow in SCHEDULED else repr(flow)
        if problem or flow in found:
            raise UsageError(
                f"--schedule {text}",
                expected=f"one FLOW=CRON of each of {', '.join(SCHEDULED)}; cron is minute, hour, "
                "day, month and day of the week, and a time zone can follow",
                found=problem or f"{flow} twice",
                todo='Write it as in: --schedule reprocess="0 3 * * *". In Prefect\'s dashboard, '
                "other deployments can be scheduled too.",
            )
        found[flow] = Schedule(cron=cron, timezone=zone)
    return found


def _local_timezone() -> str:
    """Return the name of this machine's time zone; UTC if it has none."""
    place = os.environ.get("TZ") or os.path.realpath("/etc/localtime")
    name = place.rpartition("zoneinfo/")[2].lstrip(":")
    return name if name and not Path(name).is_absolute() else "UTC"


def _problem(cron: str, zone: str) -> str:
    from prefect.client.schemas.schedules import CronSchedule  # late: it takes seconds
    from pydantic import ValidationError

    try:
        CronSchedule(cron=cron, timezone=zone)
    except ValidationError as error:
        return str(error.errors()[0]["msg"]).removeprefix("Value error, ")
    return ""


def set_schedule(
    prefect: PrefectApi,
    deployment: Mapping[str, Any],
    wanted: Schedule | None,
    before: Schedule | None,
) -> None:
    """Make or change the schedule of `--schedule` if the option differs from that `before`.

    Otherwise the schedule stays, also if the operator has changed, paused or removed it.
    """
    if wanted is None or wanted == before:
        return
    place, schedule = f"/deployments/{deployment['id']}/schedules", wanted.model_dump()
    there = [each["id"] for each in deployment["schedules"] if each["slug"] == SLUG]
    if there:
        prefect.ask(f"{place}/{there[0]}", {"schedule": schedule}, method="PATCH")
    else:
        prefect.ask(place, [{"schedule": schedule, "active": True, "slug": SLUG}])
