"""Settings carry the unit of their value."""

import ast
import re
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from structure import ROOT

SUFFIXES = {
    **{"m": "_m", "px": "_px", "s": "_s", "frame": "_frames", "rad": "_rad", "deg": "_deg"},
    **{"m/s": "_m_s", "m/s^2": "_m_s2", "Hz": "_hz", "1/m": "_per_m", "1/min": "_per_min"},
}
"""Suffix of a name by the unit in its description's brackets; other units are dimensionless."""
RECORDS = re.compile(r"(Settings|Prior|Limits)$")
MORE_RECORDS = {"ActionRates", "CalibrationErrors", "ObservationNoise", "Seat"}
ARRAYS = {"MonocularPrior", "PosePrior"}
"""Data of a computation, which no user sets."""
KEPT = {("DetectionSettings", "stride")}
"""Known under this name to users of other detectors."""


class Setting(NamedTuple):
    """A field of settings with its description."""

    record: str
    name: str
    description: str

    def fault(self) -> str | None:
        """Return what is wrong with the name, None if nothing is."""
        units = re.findall(r"\[([^\]]+)\]", self.description)
        expected = {SUFFIXES[unit] for unit in units if unit in SUFFIXES}
        ends = [suffix for suffix in SUFFIXES.values() if self.name.endswith(suffix)]
        found = {max(ends, key=len)} if ends else set()
        if expected != found and (self.record, self.name) not in KEPT:
            return f"{self.record}.{self.name}: unit in brackets {units}, suffix {sorted(found)}"
        if re.match("(least|most|fewest|longest|largest)_", self.name):
            return f"{self.record}.{self.name}: bounds begin with min_ or max_"
        return None


def settings_in(source: str) -> Iterator[Setting]:
    """Yield the settings of a module."""
    for record in ast.parse(source).body:
        if not isinstance(record, ast.ClassDef) or record.name in ARRAYS:
            continue
        if not RECORDS.search(record.name) and record.name not in MORE_RECORDS:
            continue
        for field, after in zip(record.body, [*record.body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                described = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                text = str(after.value.value) if described else ""
                yield Setting(record.name, field.target.id, text)


def test_the_unit_in_a_description_is_the_suffix_of_the_name():
    packages = ("data_contracts", "worldpose", "tasks", "flows")
    files = [path for name in packages for path in (ROOT / name).rglob("*.py")]
    found = [each for path in files for each in settings_in(path.read_text(encoding="utf-8"))]
    assert len(found) > 350
    assert [fault for each in found if (fault := each.fault())] == []


@pytest.mark.parametrize(
    ("name", "description", "right"),
    [
        ("gate_m", "Maximum distance [m].", True),
        ("gate", "Maximum distance [m].", False),
        ("speed_m_s", "[m/s]", True),
        ("speed_m", "[m/s]", False),
        ("share_s", "Share [1].", False),
        ("share", "Share [1].", True),
        ("most_people", "[1]", False),
    ],
)
def test_names_with_and_without_their_unit(name, description, right):
    source = f'class SampleSettings:\n    {name}: float = 1.0\n    """{description}"""\n'
    (setting,) = settings_in(source)
    assert (setting.fault() is None) == right
