"""Records of runs of which a test states what it is about."""

from datetime import UTC, datetime

from data_contracts.run import RunRecord
from data_contracts.usability import Usability

AT = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)


def run_record(**stated):
    """Return the record of a complete run without units, but for what is stated."""
    plain = {
        **{"run_id": "0001", "match_id": "m", "parent": None, "state": "complete", "seconds": 1.0},
        **{name: {} for name in ("results", "settings", "overrides", "versions", "figures")},
        **dict.fromkeys(("executed", "reused", "failed", "blocked"), ()),
        **dict.fromkeys(("started_at", "finished_at"), AT),
        "usability": Usability(verdict="usable"),
    }
    return RunRecord(**(plain | stated))
