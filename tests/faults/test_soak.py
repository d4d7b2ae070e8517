"""A few minutes of seeded random faults; and that their checks find what is wrong.

`python tests/faults/soak.py --minutes 30` runs longer, and prints what it observed.
"""

from pathlib import Path

import pytest
from machines import may_cut_and_fill
from soak import FAULTS, soak

pytestmark = [
    pytest.mark.faults,
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(not may_cut_and_fill(), reason="links and disks need the rights of root"),
]

SPOIL = Path(__file__).with_name("spoil.py")


def test_matches_under_random_faults_end_as_undisturbed_ones(tmp_path):
    report = soak(minutes=3, seed=0, folder=tmp_path / "soak")
    assert report["problems"] == []
    assert report["tracebacks"] == []
    assert report["matches_done"] >= 3
    assert report["faults"].keys() <= FAULTS.keys()
    assert report["faults"], "nothing struck"


@pytest.mark.parametrize(
    ("how", "found"),
    [
        # Each process computes bytes of its own: what is computed again is another result.
        ("own", "the bytes differ"),
        # Manifest first: workers that are killed in between leave halves.
        ("half", "is missing"),
    ],
)
def test_a_store_that_keeps_no_promise_is_found(how, found, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLDPOSE_TEST_SPOIL", how)
    report = soak(
        minutes=1,
        seed=0,
        folder=tmp_path / "soak",
        matches=1,
        preload=SPOIL,
        kinds=("worker's child killed",),
        between=(0.05, 0.2),
        max_starts=3,
    )
    assert any(found in problem for problem in report["problems"]), report
