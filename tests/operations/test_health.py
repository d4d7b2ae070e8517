"""What is not well is said, with what to do about it."""

import os
from datetime import UTC, datetime

import pytest

from data_contracts.operations import Service, Serving
from flows.operations.health import check
from flows.operations.layout import StateFolder


@pytest.fixture
def state(tmp_path):
    return StateFolder(tmp_path / "operations")


def serving(tmp_path, prefect, **services):
    return Serving(
        project=str(tmp_path),
        inbox=str(tmp_path / "inbox"),
        name="healthy",
        prefect=prefect,
        owns_prefect=False,
        services={"serve": Service(pid=os.getpid()), **services},
        started_at=datetime.now(UTC),
    )


def by_part(findings):
    return {finding.part: finding for finding in findings}


def test_what_was_never_started_or_killed_is_said(state, tmp_path):
    (finding,) = check(state)
    assert (finding.part, finding.is_well) == ("serve", False)
    assert "not started" in finding.state
    state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
    (finding,) = check(state)
    assert "killed" in finding.state
    assert "worldpose serve" in finding.mend


def test_every_part_that_is_not_well_says_how_to_mend_it(server, state, tmp_path):
    dead = Service(pid=2**22 + 1, address="http://127.0.0.1:9")
    state.write_serving(serving(tmp_path, server, pages=dead))
    with state.only_one("serve", wait=False):
        found = by_part(check(state))
        assert {part for part, each in found.items() if each.is_well} == {
            "serve",
            "prefect",
            "disk",
        }
        assert "match" in found["deployments"].state
        assert "worker.log" in found["worker of healthy"].mend
        assert "pages.log" in found["pages"].mend
        assert "inbox" in found["inbox"].mend
        assert all(each.mend for each in found.values() if not each.is_well)
        # Without its server nothing is known of deployments, and the server is to be mended first.
        state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
        (tmp_path / "inbox").mkdir()
        found = by_part(check(state))
        assert "Start the Prefect server" in found["prefect"].mend
        assert found["deployments"].mend == "Mend prefect first."
        assert found["inbox"].is_well
