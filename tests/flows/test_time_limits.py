"""Time limits of units and schedules, parsed from the form in which people write them."""

import re

import pytest

from flows.method import METHOD
from flows.service.plan import parse_schedules
from flows.settings import DEFAULT_MINUTES, parse_time_limits, seconds_of
from worldpose.errors import UsageError


def test_a_number_is_for_every_stage_and_one_with_a_name_for_that():
    assert seconds_of("tracking", {}) == 60.0 * DEFAULT_MINUTES
    limits = parse_time_limits(["30", "detection=120"])
    assert {stage.name for stage in METHOD} == limits.keys()
    assert (seconds_of("tracking", limits), seconds_of("detection", limits)) == (1800.0, 7200.0)
    assert parse_time_limits(["ingest=0.5"]) == {"ingest": 0.5}


@pytest.mark.parametrize("text", ["0", "-3", "inf", "nan", "soon", "tracks=3", "=3", "tracking="])
def test_what_is_no_limit_is_refused(text):
    with pytest.raises(UsageError, match="--time-limit"):
        parse_time_limits([text])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("reprocess=0 3 * *", "Invalid cron string"),
        ("reprocess=0 3 * * * Mars/X", "Invalid timezone"),
        ("match=0 3 * * *", "'match'"),
        ("0 3 * * *", "'0 3"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused_before_anything_starts(text, said):
    with pytest.raises(UsageError, match=re.escape(said)):
        parse_schedules([text])
    with pytest.raises(UsageError, match="twice"):
        parse_schedules(["reprocess=0 3 * * * UTC", "reprocess=0 4 * * * UTC"])
