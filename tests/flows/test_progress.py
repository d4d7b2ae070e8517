"""Progress reports of a running run."""

import pytest

from flows.progress import MOST_TOLD, Reporter


class Heard(Reporter):
    """Keeps the units that it would tell of."""

    def __init__(self):
        self.told = []

    def tell_of(self, unit, seconds, figures):
        self.told.append(unit)


@pytest.mark.parametrize(("units", "told"), [(1, 1), (200, 200), (201, 101), (5000, 200)])
def test_of_very_many_units_some_are_told_of_and_the_last_is(units, told):
    heard = Heard()
    heard.stage_started("ingest", "take in", units=units, missing=units)
    for number in range(units):
        heard.unit_done(f"ingest/c{number}", 0.1, {})
    assert len(heard.told) == told <= MOST_TOLD
    assert heard.told[-1] == f"ingest/c{units - 1}"
    assert heard.left == 0


def test_every_failure_is_told_of_and_counts(caplog):
    heard = Heard()
    heard.stage_started("ingest", "take in", units=1000, missing=1000)
    for number in range(1000):
        heard.unit_failed(f"ingest/c{number}", "why")
    assert heard.left == 0
    assert len([each for each in caplog.records if each.levelname == "ERROR"]) == 1000
