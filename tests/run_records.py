"""Records of runs of which a test states what it is about."""

from collections.abc import Mapping
from datetime import UTC, datetime
from types import SimpleNamespace

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


class StubRun(Mapping):
    """Results by name, as an opened run has them."""

    def __init__(self, results, store, **stated):
        self.results, self.store = results, store
        about = {"run_id": "0001", "match_id": "m", "state": "complete"}
        about["results"] = dict.fromkeys(results, "0" * 32)
        about |= {"left_out": {}, "body_folder": None, "usability": Usability(verdict="usable")}
        self.record = SimpleNamespace(**(about | stated))

    def manifest(self, name):
        return SimpleNamespace(recipe=SimpleNamespace(sources={}))

    def __getitem__(self, name):
        return self.results[name]

    def __iter__(self):
        return iter(self.results)

    def __len__(self):
        return len(self.results)
