"""Where a run's time went: units side by side count once in what elapsed."""

from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest

from flows.results import timings

BEGUN = datetime(2026, 5, 1, 12, tzinfo=UTC)


class Told:
    """A store of one run: unit to end time since the run's start, and duration [s]."""

    units = {
        "ingest/a": (12.0, 2.0),
        "ingest/b": (13.0, 2.0),
        "tracking/c1": (20.0, 5.0),
        "tracking/c2": (20.0, 4.0),
    }

    def run(self, match, run):
        results = dict.fromkeys(self.units, "key")
        executed = tuple(self.units)
        return SimpleNamespace(
            match_id=match,
            run_id=run,
            seconds=22.0,
            started_at=BEGUN,
            executed=executed,
            results=results,
        )

    def manifest(self, match, stage, unit, key):
        end, seconds = self.units[f"{stage}/{unit}"]
        files = (SimpleNamespace(size=700), SimpleNamespace(size=50))
        at = BEGUN + timedelta(seconds=end)
        return SimpleNamespace(created_at=at, seconds=seconds, files=files)


def test_what_elapsed_counts_units_side_by_side_once():
    found = timings.run_time(Told(), "m", "0001")
    ingest, tracking = found.stages
    assert (ingest.stage, ingest.units, ingest.work, ingest.longest) == ("ingest", 2, 4.0, 2.0)
    # 10 to 13 s of the run; then 15 to 20 s.
    assert (ingest.elapsed, tracking.elapsed) == (3.0, 5.0)
    assert (tracking.work, found.start) == (9.0, 10.0)
    # 13 to 15 s, and 20 to 22 s.
    assert found.between == pytest.approx(4.0)
    assert found.seconds == found.start + found.between + ingest.elapsed + tracking.elapsed
