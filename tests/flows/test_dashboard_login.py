"""The log-in in front of Prefect, before a stub that answers all requests alike."""

import json
import shutil
import subprocess
from importlib.resources import files
from urllib.parse import parse_qs, urlsplit

import pytest
from page_client import TOKEN, TestClient
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect

from flows.orchestration.dashboard_login import DashboardLogin
from flows.web.access import access_for

PORT = "http://127.0.0.1:4200"
PAGE = {"accept": "text/html,application/xhtml+xml"}
ROLES = {"Ada": "approver", "Vera": "viewer"}


@pytest.fixture
def access(tmp_path):
    users = tmp_path / "users.toml"
    entries = [f'[users.{who}]\nrole = "{ROLES[who]}"\ntoken = "{TOKEN}{who}"' for who in ROLES]
    users.write_text("\n".join(entries))
    users.chmod(0o600)
    return access_for("127.0.0.1", token=TOKEN, names=(), secure=False, users=users)


def browser(access, who=None, answer=None):
    """A browser at Prefect's port, with the session of a person."""
    answer = answer or Response("of Prefect")
    cookies = None if who is None else {access.cookie: access.session(who)}
    app = DashboardLogin(answer, access, "worldpose:login")
    return TestClient(app, base_url=PORT, cookies=cookies, follow_redirects=False)


@pytest.mark.parametrize("who", [None, "Vera", "Ada"])
def test_files_and_health_need_no_session_in_a_browser_either(access, who):
    opened = browser(access, who)
    files = ("/assets/index-1.js", "/v2/fonts/a.woff2", "/ico/favicon.svg", "/robots.txt")
    for path in ("/api/health", "/api/ready", *files):
        answer = opened.get(path, headers=PAGE)
        assert (answer.status_code, answer.text) == (200, "of Prefect"), path
    for path in ("/runs", "/work-pools/work-pool/a.js", "/api/healthy", "/api/docs"):
        status = {None: 303, "Vera": 403, "Ada": 200}[who]
        assert opened.get(path, headers=PAGE).status_code == status, path


def test_a_person_who_may_not_use_prefect_can_log_out_and_another_in(access):
    vera = browser(access, "Vera")
    session = vera.cookies[access.cookie]
    assert "/login" in vera.get("/runs", headers=PAGE).json()["error"]
    # 401 keeps the form open.
    answer = vera.get("/api/session")
    assert (answer.status_code, browser(access).get("/api/session").status_code) == (401, 401)
    headers = {"x-form-secret": answer.json()["form_secret"]}
    assert vera.post("/api/logout", json={}).status_code == 403
    assert access.person(session) == "Vera"
    assert vera.post("/api/logout", json={}, headers=headers).json() == {"next": "/login"}
    assert access.person(session) is None
    given = {"who": "Ada", "token": TOKEN + "Ada"}
    assert vera.post("/api/login", json=given).status_code == 200
    assert vera.get("/runs", headers=PAGE).text == "of Prefect"


def test_changes_at_prefect_are_logged_with_their_person(access, caplog):
    caplog.set_level("INFO", "worldpose.pages")
    ada = browser(access, "Ada", Response(status_code=202))
    own = {"origin": PORT}
    ada.delete("/api/deployments/1/filter", headers=own)
    ada.post("/api/flow_runs/1/set_state%0A", headers=own)
    ada.post("/api/work_pools/count-1/queues", headers=own)
    for path in ("flow_runs/filter", "ui/task_runs/dashboard/counts", "events/count-by/day"):
        ada.post(f"/api/{path}", headers=own)  # asked all the time by the dashboard
    ada.get("/api/flows/1")
    assert [record.getMessage() for record in caplog.records] == [
        "Ada: 'DELETE /api/deployments/1/filter': 202",
        "Ada: 'POST /api/flow_runs/1/set_state\\n': 202",
        "Ada: 'POST /api/work_pools/count-1/queues': 202",
    ]


def test_of_the_dashboards_settings_only_a_good_answer_is_changed(access):
    settings = b'{"auth": "BASIC", "flags": []}'
    for method, status, said, expected in (
        ("GET", 200, settings, b'{"auth":null,"flags":[]}'),
        ("POST", 200, settings, settings),
        ("GET", 503, settings, settings),
        ("GET", 500, b"Internal Server Error", b"Internal Server Error"),
    ):
        ada = browser(access, "Ada", Response(said, status))
        answer = ada.request(method, "/ui-settings", headers={"origin": PORT})
        assert (answer.status_code, answer.content) == (status, expected), (method, status)


def test_a_websocket_whose_first_message_is_not_json_is_closed_with_the_reason(access):
    async def stream(scope, receive, send):
        await receive()
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            await send({"type": "websocket.send", "text": "heard"})

    with (
        browser(access, "Ada", stream).websocket_connect("/api/ws", headers={"origin": PORT}) as it,
        pytest.raises(WebSocketDisconnect) as closed,
    ):
        it.send_text("auth: me")
        it.receive_text()
    assert closed.value.code == 1007
    assert closed.value.reason == "expected JSON in the first message, found other text"


@pytest.mark.parametrize("asked", ["/runs", "/runs/a%2Fb", "/x%3Fq?tab=a%26b&c", "/%ff", "/a%25b"])
def test_the_form_leads_back_to_the_very_address(access, asked):
    there = browser(access).get(asked, headers=PAGE).headers["location"]
    assert parse_qs(urlsplit(there).query, errors="strict") == {"next": [asked]}


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
@pytest.mark.parametrize(
    ("place", "status", "says_yes", "expected"),
    [
        ("", 200, True, ["/runs"]),  # goes on
        ("", 401, True, []),  # the form stays
        ("#out", 200, True, ["/api/logout s", "/login"]),
        ("#out", 401, True, ["/api/logout s", "/login"]),
        ("#out", 200, False, ["/runs"]),
    ],
)
def test_the_form_goes_on_stays_or_asks_whether_to_log_out(place, status, says_yes, expected):
    page = files("flows.web") / "login" / "page.js"
    script = f"""
      const seen = [], field = {{ focus() {{}}, addEventListener() {{}} }};
      globalThis.document = {{ getElementById: () => field }};
      globalThis.localStorage = {{ getItem: () => "" }};
      globalThis.location = {{ hash: "{place}", search: "?next=%2Fruns" }};
      location.replace = (to) => seen.push(to);
      globalThis.confirm = () => {json.dumps(says_yes)};
      globalThis.fetch = async (path, sent) => {{
        if (sent) seen.push(`${{path}} ${{sent.headers["x-form-secret"]}}`);
        const answer = sent ? {{ next: "/login" }} : {{ form_secret: "s" }};
        return {{ ok: {status} === 200, json: async () => answer }};
      }};
      require({json.dumps(str(page))});
      setTimeout(() => console.log(JSON.stringify(seen)), 50);
    """
    said = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    assert json.loads(said.stdout) == expected
