"""One command, a match in the inbox, a question, a verdict, the result, whatever is killed."""

import json
import shutil
import signal
import urllib.error

import pytest
from command_line import succeed, worldpose
from service import TOKEN, Browser, fetch, free_ports, wait_until

from worldpose.store.store import Store

pytestmark = pytest.mark.slow  # a Prefect server, a worker, and a match from end to end


@pytest.mark.timeout(3600)
def test_a_match_in_the_inbox_becomes_a_result_with_one_command(served, webhook, tmp_path):
    succeed("simulate", "--scenario", "tiny", "--duration", 0.5, "--out", tmp_path / "match")
    name = "tiny-0-0.5s"
    served.begin()
    healthy = served.check()
    assert (healthy.code, healthy.json["healthy"]) == (0, True), healthy.out
    # A copy with a link that leads out of it is refused; the good one is taken.
    shutil.copytree(tmp_path / "match", served.project / "inbox" / "urgent" / "hostile")
    (served.project / "inbox" / "urgent" / "hostile" / "stills" / "x").symlink_to("/etc/passwd")
    shutil.copytree(tmp_path / "match", served.project / "inbox" / "good")
    wait_until(lambda: served.runs(name), served.explain)
    browser = Browser(served)
    store = Store.open(str(served.project))

    wait_until(lambda: served.runs(name)[0]["state_name"] == "Suspended", served.explain)
    # Everything is killed while the run waits, and resumes after a restart.
    assert (served.end(signal.SIGKILL), served.check().code) == (0, 1)
    served.begin()
    browser = Browser(served)
    assert browser.approve_all(name) > 0

    # Killed during the run: after a restart it resumes automatically.
    wait_until(lambda: served.runs(name)[0]["state_name"] == "Running", served.explain)
    assert served.end(signal.SIGTERM) == 0
    served.begin()
    browser = Browser(served)

    def is_done():
        browser.approve_all(name)
        (run,) = served.runs(name)
        # In between it is "Crashed" for a moment, until it restarts.
        assert run["state_name"] != "Failed", run["state"]["message"]
        return run["state_name"] == "Completed"

    wait_until(is_done, served.explain)
    record = store.run(name)
    assert (record.state, record.failed, record.waiting) == ("complete", (), ())
    assert record.figures["body_fitting/clip"]["bodies"] > 0

    status = browser.ask("/api/status")
    assert [match["state"] for match in status["matches"]] == ["complete"]
    arrivals = {each["name"]: each for each in status["arrivals"]}
    assert arrivals["good"]["flow_run"] == served.runs(name)[0]["id"]
    assert arrivals["urgent/hostile"]["state"] == "refused"
    assert "is a link" in arrivals["urgent/hostile"]["reason"]
    assert served.project.joinpath("inbox", "good", "match.yaml").is_file()
    figures = served.figures()
    assert 'worldpose_matches{state="complete"} 1.0' in figures
    assert fetch(f"http://127.0.0.1:{served.ports['prefect']}/").startswith("<!")

    # A release is begun in Prefect's dashboard, as this call of it does.
    deployment = served.ask("/deployments/name/release/worldpose-release")["id"]
    given = {"match_id": name, "name": "v1", "licence": "for tests"}
    begun = served.ask(f"/deployments/{deployment}/create_flow_run", {"parameters": given})
    wait_until(
        lambda: served.ask(f"/flow_runs/{begun['id']}")["state_name"] == "Completed", served.explain
    )
    released = served.project / "releases" / name
    assert json.loads((released / "v1" / "manifest.json").read_text())["release"] == "v1"
    assert "body_fitting" in (released / "v1-report.html").read_text()

    # The inbox is also gone through on schedule, and the webhook was told, each matter once.
    scheduled = {"flow_runs": {"tags": {"any_": ["auto-scheduled"]}, "name": {"like_": "inbox, "}}}
    wait_until(lambda: served.ask("/flow_runs/filter", scheduled), served.explain)
    kinds = {"disk_low", "arrival_refused"}
    wait_until(lambda: kinds <= {alert["alert"] for _, alert in webhook.posted})
    texts = [alert["text"] for _, alert in webhook.posted if alert["alert"] == "arrival_refused"]
    assert len(texts) == len(set(texts))
    secrets = (TOKEN, "token=secret")
    for file in (served.project / "operations").rglob("*"):
        if file.is_file():
            assert not any(secret.encode() in file.read_bytes() for secret in secrets), file
    assert (served.end(signal.SIGINT), served.check().code) == (0, 1)


def test_a_second_service_of_a_project_and_an_absent_server_are_refused(tmp_path):
    from flows.service.layout import StateFolder

    project = tmp_path / "project"
    state = StateFolder(project / "operations")
    state.folder.mkdir(parents=True)
    with state.only_one("serve", wait=False):
        answer = worldpose("serve", "--project", project)
        assert answer.code == 2
        assert "another process" in answer.err
    server, pages = free_ports(2)
    absent = {"PREFECT_API_URL": f"http://127.0.0.1:{server}/api"}
    answer = worldpose("serve", "--project", project, "--port", pages, environment=absent)
    assert answer.code == 2
    assert "running Prefect server" in answer.err
    with pytest.raises(urllib.error.URLError):
        fetch(absent["PREFECT_API_URL"])
