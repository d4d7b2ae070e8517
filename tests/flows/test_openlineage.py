"""Lineage of a run as OpenLineage events, checked against the published schema."""

import json

import pytest
from command_line import TINY

from data_contracts.run import UnitFailure
from flows.openlineage import lineage_events, tell_lineage
from worldpose.store.store import Store

KINDS = ("START", "COMPLETE", "FAIL")


@pytest.fixture
def store(tiny_run):
    return Store.open(str(tiny_run))


@pytest.fixture
def record(store):
    failed = UnitFailure(unit="refitting/clip", error="ValueError", message="no body", key="a" * 32)
    return store.run(TINY).model_copy(update={"failed": (failed,)})


def test_every_result_leads_back_to_the_files_of_the_match(store, record):
    events = list(lineage_events(store, record))
    assert len(events) == 2 * (len(record.executed) + 1)
    kinds = {kind: [e for e in events if e["eventType"] == kind] for kind in KINDS}
    done = kinds["COMPLETE"]
    assert len({each["job"]["name"] for each in done}) == len(done) == len(record.executed)
    made = {each["outputs"][0]["name"]: each for each in done}
    versions = {
        name: each["outputs"][0]["facets"]["version"]["datasetVersion"]
        for name, each in made.items()
    }
    assert versions == {f"results/{TINY}/{name}": key for name, key in record.results.items()}

    def sources(name):
        inputs = made[name]["inputs"]
        found = {each["name"] for each in inputs if each["namespace"] == "worldpose.match"}
        results = [each["name"] for each in inputs if each["namespace"] != "worldpose.match"]
        assert all(versions[each] for each in results)
        return found.union(*map(sources, results))

    assert sources(f"results/{TINY}/body_fitting/clip")
    starts = {each["run"]["runId"]: each["eventTime"] for each in kinds["START"]}
    assert starts.keys() == {each["run"]["runId"] for each in events}
    assert all(starts[each["run"]["runId"]] < each["eventTime"] for each in done)
    (failed,) = kinds["FAIL"]
    assert failed["run"]["facets"]["errorMessage"]["message"] == "no body"
    assert len({each["run"]["facets"]["parent"]["run"]["runId"] for each in events}) == 1


def test_events_go_to_a_server_or_a_file(store, record, webhook, tmp_path, monkeypatch, caplog):
    tell_lineage(store, record)  # nothing is set, nothing is sent
    events = list(lineage_events(store, record))
    monkeypatch.setenv("OPENLINEAGE_URL", webhook.base)
    monkeypatch.setenv("OPENLINEAGE_API_KEY", "secret")
    tell_lineage(store, record)
    assert [body for _, body in webhook.posted] == events
    assert {*webhook.asked} == {("/api/v1/lineage", "Bearer secret")}
    monkeypatch.setenv("OPENLINEAGE_URL", f"file://{tmp_path}/lineage.ndjson")
    tell_lineage(store, record)
    lines = (tmp_path / "lineage.ndjson").read_text().splitlines()
    assert [json.loads(each) for each in lines] == events
    assert caplog.messages == []
    webhook.codes = [500] * 9
    for address in (webhook.base, "http://127.0.0.1:9", "ftp://h"):
        monkeypatch.setenv("OPENLINEAGE_URL", address)
        tell_lineage(store, record)
    assert len(caplog.messages) == 3
    assert "secret" not in caplog.text
