"""A few minutes of seeded random faults; `python tests/faults/soak.py --minutes 30` runs longer."""

import pytest
from machines import may_cut_and_fill
from soak import FAULTS, soak

pytestmark = [
    pytest.mark.faults,
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(not may_cut_and_fill(), reason="links and disks need the rights of root"),
]


def test_matches_under_random_faults_end_as_undisturbed_ones(tmp_path):
    report = soak(minutes=3, seed=0, folder=tmp_path / "soak")
    assert report["problems"] == []
    assert report["matches_done"] >= 3
    assert report["faults"].keys() <= FAULTS.keys()
    assert report["faults"], "nothing struck"
