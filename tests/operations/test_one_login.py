"""Who has logged in to the pages of `serve` as approver has logged in to Prefect's dashboard."""

import json
import signal
import time
import urllib.request
from http.cookiejar import CookieJar
from urllib.parse import quote
from uuid import uuid4

import pytest
from service import TOKEN, Served, fetch, request
from websockets.sync.client import connect

from flows.web.access import SESSION_SECONDS, access_for

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

PEOPLE = {"Ada": "approver", "Ann": "annotator", "Vera": "viewer"}
RUN = "/runs/flow-run/0123?tab=Logs"
PAGE = {"accept": "text/html,application/xhtml+xml"}


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    users = folder / "users.toml"
    entries = [f'[users.{who}]\nrole = "{PEOPLE[who]}"\ntoken = "{TOKEN}{who}"' for who in PEOPLE]
    users.write_text("\n".join(entries))
    users.chmod(0o600)
    service = Served(folder, "http://127.0.0.1:9/alert")
    service.options = {"--users": users}
    service.begin()
    yield service
    if service.process.poll() is None:
        service.end(signal.SIGKILL)


def log_in(port, who):
    jar = CookieJar()
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar))
    given = {"who": who, "token": TOKEN + who}
    fetch(f"http://127.0.0.1:{port}/api/login", given, opener=opener)
    (session,) = (each for each in jar if each.path == "/")
    return {"cookie": f"{session.name}={session.value}"}


def session_of(served, who, now=None, token=TOKEN):
    users = served.options["--users"]
    access = access_for("127.0.0.1", token=token, names=(), secure=False, users=users)
    name = access_for("127.0.0.1", token=TOKEN, names=(), secure=False).cookie
    return {"cookie": f"{name}={access.session(who, now)}"}


def opened(served, cookie, first=None):
    port = served.ports["prefect"]
    stream = connect(
        f"ws://127.0.0.1:{port}/api/logs/out",
        origin=f"http://127.0.0.1:{port}",
        subprotocols=["prefect"],
        additional_headers=cookie,
        open_timeout=30,
    )
    stream.send(json.dumps(first or {"type": "auth", "token": None}))
    return stream


def test_one_log_in_opens_pages_and_dashboard_until_the_log_out(served):
    pages, prefect = served.ports["pages"], served.ports["prefect"]
    ada, other = log_in(pages, "Ada"), log_in(pages, "Ada")
    own = {"origin": f"http://127.0.0.1:{prefect}"}
    count = "/api/flows/count"
    # What the dashboard of an earlier log-in by password still sends does not matter.
    for headers in (own, {"sec-fetch-site": "same-origin", "authorization": "Basic b2xk"}):
        assert request(prefect, "POST", count, {**ada, **headers}, {})[::2] == (200, b"5")
    assert request(prefect, "GET", "/api/admin/version", ada)[0] == 200
    assert b"<title>" in request(prefect, "GET", RUN, {**ada, **PAGE})[2]
    for headers, asks_for in (({}, "BASIC"), (ada, None)):
        zipped = {**headers, "accept-encoding": "gzip"}
        assert json.loads(request(prefect, "GET", "/ui-settings", headers)[2])["auth"] == asks_for
        assert request(prefect, "GET", "/ui-settings", zipped)[0] == 200
    # A change must come from the dashboard itself.
    for headers, status in (
        ({}, 401),
        ({"origin": "http://evil.example"}, 403),
        ({"origin": f"http://127.0.0.1:{pages}"}, 403),
        ({"sec-fetch-site": "same-site"}, 403),
    ):
        assert request(prefect, "POST", count, {**ada, **headers}, {})[0] == status, headers
    with opened(served, ada) as stream, opened(served, other) as another:
        for each in (stream, another):
            assert json.loads(each.recv(30)) == {"type": "auth_success"}
        _, _, session = request(pages, "GET", "/api/session", ada)
        secret = {"x-form-secret": json.loads(session)["form_secret"]}
        assert request(pages, "POST", "/api/logout", {**ada, **secret}, {})[0] == 200
        began = time.monotonic()
        with pytest.raises(Exception, match="1008"):
            stream.recv(30)
        assert time.monotonic() - began < 10.0
        with pytest.raises(TimeoutError):
            another.recv(2)
    assert request(prefect, "POST", count, {**ada, **own}, {})[0] == 401
    assert request(prefect, "GET", "/api/admin/version", ada)[0] == 401
    assert request(prefect, "POST", count, {**other, **own}, {})[0] == 200
    ended = served.project / "operations" / "secrets" / "ended"
    assert ended.stat().st_mode & 0o777 == 0o700
    assert len(list(ended.iterdir())) == 1


def test_no_other_session_opens_prefect(served):
    port = served.ports["prefect"]
    own = {"origin": f"http://127.0.0.1:{port}"}
    cookies = {
        "nobody": {},
        "viewer": log_in(served.ports["pages"], "Vera"),
        "annotator": log_in(served.ports["pages"], "Ann"),
        "expired": session_of(served, "Ada", time.time() - SESSION_SECONDS - 1.0),
        "forged": session_of(served, "Ada", token="another token, long"),
        "unknown": session_of(served, "Eve"),
    }
    for who, cookie in cookies.items():
        for method, path in (("POST", "/api/flows/count"), ("GET", "/api/admin/version")):
            body = {} if method == "POST" else None
            assert request(port, method, path, {**cookie, **own}, body)[0] == 401, who
        with opened(served, cookie) as stream, pytest.raises(Exception, match="1008"):
            stream.recv(30)
        status, headers, content = request(port, "GET", RUN, {**cookie, **PAGE})
        if who in ("viewer", "annotator"):
            assert (status, who.encode() in content) == (403, True), who
        else:
            there = f"/login?next={quote(RUN, safe='/')}"
            assert (status, headers["location"]) == (303, there), who
    # A session opens a WebSocket to the dashboard's own pages alone.
    address = f"ws://127.0.0.1:{port}/api/logs/out"
    ada = session_of(served, "Ada")
    assert request(port, "GET", "/api/admin/version", ada)[0] == 200
    with connect(address, subprotocols=["prefect"], additional_headers=ada) as stream:
        stream.send(json.dumps({"type": "auth", "token": None}))
        with pytest.raises(Exception, match="1008"):
            stream.recv(30)


def test_the_form_at_the_dashboard_opens_the_pages_too(served):
    pages, prefect = served.ports["pages"], served.ports["prefect"]
    assert b'id="token"' in request(prefect, "GET", "/login", PAGE)[2]
    assert request(prefect, "GET", "/api/session")[0] == 401
    foreign = {"origin": f"http://127.0.0.1:{pages}"}
    given = {"who": "Ada", "token": TOKEN + "Ada"}
    assert request(prefect, "POST", "/api/login", foreign, given)[0] == 403
    assert request(prefect, "POST", "/api/login", {}, {**given, "token": TOKEN})[0] == 401
    assert request(prefect, "POST", "/api/login", {}, {"who": "\ud800"})[0] == 422
    ada = log_in(prefect, "Ada")
    assert request(prefect, "GET", "/api/session", ada)[0] == 200
    assert request(prefect, "GET", "/api/admin/version", ada)[0] == 200
    assert request(pages, "GET", "/api/matches", ada)[0] == 200
    for path in ("/api/health", "/api/ready"):
        assert request(prefect, "GET", path, PAGE)[0] == 200
    gone = f"/api/flow_runs/{uuid4()}"
    own = {"origin": f"http://127.0.0.1:{prefect}"}
    assert request(prefect, "DELETE", gone, {**ada, **own})[0] == 404
    vera = log_in(prefect, "Vera")
    status, _, session = request(prefect, "GET", "/api/session", vera)
    assert status == 401
    secret = {"x-form-secret": json.loads(session)["form_secret"]}
    assert request(pages, "GET", "/api/session", vera)[0] == 200
    assert request(prefect, "POST", "/api/logout", {**vera, **secret}, {})[0] == 200
    assert request(pages, "GET", "/api/session", vera)[0] == 401
    log = (served.project / "operations" / "logs" / "prefect.log").read_text()
    for line in ("POST /api/login': 200", f"DELETE {gone}': 404"):
        assert f"Ada: '{line}" in log
