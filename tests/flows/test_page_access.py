"""The pages' server lets in who it should, and refuses what a page does not send."""

import json
import logging
import os
import sys
import threading
import time

import page_client
import pytest
from command_line import TINY
from page_client import HERE, MATCH, TOKEN, a_click, moved

from flows.cli.options import certificate_and_key
from flows.web.access import EDITING, SESSION_SECONDS, WRONG_TOKENS, access_for
from flows.web.app import create_app
from flows.web.guard import BODY_BYTES, OPEN
from worldpose.errors import UsageError
from worldpose.review.journal import read_journal
from worldpose.store.store import Store


@pytest.fixture
def app(tiny_run):
    """The server of a project in which nothing is changed."""
    return page_client.served(tiny_run)


def every_route(app):
    """Method and path of every route of the server, from the server itself."""
    names = {"match_id": TINY, "owner": "cam00", "request": "r", "number": "0", "clip": "clip"}
    names |= {"form": "joints", "draft": "0123456789abcdef", "file": "f", "group": "g"}
    names |= {"before": "0001", "after": "0002", "name": "n", "kind": "css", "camera": "cam00"}
    for path, methods in app.openapi()["paths"].items():
        for method in methods:
            yield method.upper(), path.format_map(names)


def refused(browser, method, path, **keywords):
    return browser.request(method, path, follow_redirects=False, **keywords)


def test_every_route_but_log_in_and_health_refuses_a_stranger(app, stranger):
    routes = list(every_route(app))
    some = {MATCH, f"{MATCH}/decisions", "/", "/api/session", "/api/drafts"}
    assert {path for _, path in routes} >= some
    for method, path in routes:
        answer = refused(stranger, method, path, json={} if method == "POST" else None)
        if path in OPEN:
            assert answer.status_code in (200, 422), path
        elif path == "/":
            assert (answer.status_code, answer.headers["location"]) == (303, "/login")
        else:
            assert answer.status_code == 401, path
    assert refused(stranger, "GET", "/api/no-such-route").status_code == 401


def test_a_wrong_token_a_forged_session_and_one_that_is_over_open_nothing(app, stranger):
    answer = stranger.post("/api/login", json={"who": "Eve", "token": TOKEN + "x"})
    assert (answer.status_code, "set-cookie" in answer.headers) == (401, False)
    access = app.state.access
    good = access.session("Ada")
    packed, signature = good.split(".")
    other = access_for("127.0.0.1", token="another token, as long", names=(), secure=False)
    over = access.session("Ada", now=0.0)
    last = "0" if signature[-1] != "0" else "1"
    forged = [f"{packed}.{signature[:-1]}{last}", f"{packed[:-2]}.{signature}"]
    for cookie in [*forged, other.session("Ada"), over, "", ".", "%%", "é"]:
        assert access.person(cookie) is None
    for cookie in (forged[0], over):
        answer = stranger.get(MATCH, headers={"cookie": f"{access.cookie}={cookie}"})
        assert answer.status_code == 401
    assert access.person(good) == "Ada"
    assert access.person(access.session("Ada", now=0.0), now=SESSION_SECONDS - 1.0) == "Ada"


def test_the_cookie_is_out_of_reach_of_scripts_and_of_other_sites(tiny_run, stranger):
    cookie = stranger.post("/api/login", json={"who": "Ada", "token": TOKEN}).headers["set-cookie"]
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))
    assert "Secure" not in cookie
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=True)
    browser = page_client.browser(create_app(str(tiny_run), access))
    cookie = browser.post("/api/login", json={"who": "A", "token": TOKEN}).headers["set-cookie"]
    assert "Secure" in cookie


def test_a_change_needs_the_form_secret_json_and_this_origin(ada, tiny_run):
    before = read_journal(Store.open(str(tiny_run)), TINY).entries
    body = {"correction": "c"}
    secret = ada.headers["x-form-secret"]
    wrong = [
        ({"x-form-secret": ""}, 403),
        ({"x-form-secret": secret[:-1] + ("0" if secret[-1] != "0" else "1")}, 403),
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"origin": "http://127.0.0.1:9999"}, 403),
        ({"sec-fetch-site": "cross-site"}, 403),
        ({"sec-fetch-site": "same-site"}, 403),
        ({"content-type": "text/plain"}, 415),
        ({"content-type": "application/x-www-form-urlencoded"}, 415),
    ]
    for headers, status in wrong:
        answer = ada.post(f"{MATCH}/withdrawals", json=body, headers=headers)
        assert answer.status_code == status, headers
    # The same from the page itself reaches the journal, which has no such correction.
    right = {"origin": HERE, "sec-fetch-site": "same-origin"}
    assert ada.post(f"{MATCH}/withdrawals", json=body, headers=right).status_code == 422
    assert read_journal(Store.open(str(tiny_run)), TINY).entries == before
    assert "access-control-allow-origin" not in ada.get("/api/matches").headers


def test_nothing_is_changed_by_getting(project_copy, monkeypatch):
    report = lambda store, match, file, **given: file.write_text("a page")  # noqa: E731
    monkeypatch.setattr("flows.web.results.write_report", report)  # it takes seconds
    app = page_client.served(project_copy)
    ada = page_client.log_in(app, "Ada")

    def files():
        return {path: path.read_bytes() for path in project_copy.rglob("*") if path.is_file()}

    before = files()
    answers = {
        path: ada.get(path).status_code for method, path in every_route(app) if method == "GET"
    }
    assert answers[MATCH] == answers[f"{MATCH}/results"] == 200
    assert files() == before


def test_a_name_that_leads_here_by_rebinding_is_refused(ada):
    names = ["evil.example", "evil.example:8571", "127.0.0.1.evil.example", ""]
    names += ["evil@127.0.0.1:8571", "127.0.0.1:8571:1", "127.0.0.1/x", "[::1"]
    for host in names:
        assert ada.get("/api/matches", headers={"host": host}).status_code == 421, host
        assert ada.get("/api/health", headers={"host": host}).status_code == 421, host


def test_another_site_reads_nothing_even_with_the_session(ada):
    for headers in (
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors", "sec-fetch-dest": "image"},
        {"sec-fetch-site": "same-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": "iframe"},
    ):
        assert ada.get("/api/matches", headers=headers).status_code == 403, headers
        assert ada.options("/api/matches", headers=headers).status_code == 403, headers
    # A link on another page, as in a chat or in Prefect's dashboard, is followed.
    link = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert ada.get("/", headers={**link, "sec-fetch-dest": "document"}).status_code == 200


def test_a_session_that_was_ended_opens_nothing(app, stranger):
    ada = page_client.log_in(app, "Ada")
    cookie = {"cookie": f"{app.state.access.cookie}={ada.cookies[app.state.access.cookie]}"}
    assert stranger.get(MATCH, headers=cookie).status_code == 200
    assert ada.post("/api/logout", json={}).status_code == 200
    assert stranger.get(MATCH, headers=cookie).status_code == 401
    other = page_client.log_in(app, "Ada")
    assert other.get(MATCH).status_code == 200


def test_servers_of_one_service_forget_an_ended_session_only_after_its_expiry(tmp_path):
    def server():
        folder = tmp_path / "secrets" / "ended"
        return access_for("127.0.0.1", token=TOKEN, names=(), secure=False, ended=folder)

    first, second = server(), server()
    sessions = [first.session("Ada") for _ in range(3)]
    files = []
    for number, session in enumerate(sessions):
        assert second.person(session) == "Ada"
        first.end(session)
        for each in (first, second, server()):  # also one that starts later
            assert each.person(session) is None
        files += [file for file in second.ended.iterdir() if file not in files]
        over = time.time() - SESSION_SECONDS + (10.0 if number else -10.0)
        os.utime(files[number], (over, over))
    assert set(second.ended.iterdir()) == set(files[1:])
    assert files[1].stat().st_mode & 0o777 == 0o600


def test_guesses_are_limited_for_all_addresses_together_but_not_for_a_known_browser(app, stranger):
    ada = page_client.log_in(app, "Ada")
    wrong, right = {"who": "Ada", "token": TOKEN + "x"}, {"who": "Ada", "token": TOKEN}
    addresses = [(f"127.0.0.{number}", 5000) for number in range(1, 30)]
    clients = [page_client.TestClient(app, base_url=HERE, client=each) for each in addresses]
    codes = [client.post("/api/login", json=wrong).status_code for client in clients]
    assert 401 in codes
    assert codes.count(429) >= len(codes) - WRONG_TOKENS - 2  # a guess is forgiven each second
    assert stranger.post("/api/login", json=right).status_code == 429
    assert ada.post("/api/login", json=right).status_code == 200
    # As another person, the same browser is unknown; and its own guesses are limited too.
    assert ada.post("/api/login", json={**right, "who": "Eve"}).status_code == 429
    codes = [ada.post("/api/login", json=wrong).status_code for _ in range(WRONG_TOKENS + 2)]
    assert (codes[:WRONG_TOKENS], codes[-1]) == ([401] * WRONG_TOKENS, 429)


def test_a_slow_guesser_locks_nobody_out():
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    assert [access.may_try("", now=0.0) for _ in range(WRONG_TOKENS + 1)][-2:] == [True, False]
    assert access.may_try("another", now=0.0)
    tried = [access.may_try("", now=second) for second in range(20, 120, 2)]
    assert all(tried)
    for _ in range(50):  # right tokens use nothing up
        assert access.may_try("", now=121.0)
        access.forgive("")
    assert access.guesser("Ada", "forged.0123") == ""


def test_a_key_that_others_can_read_is_refused(tmp_path):
    key = tmp_path / "key.pem"
    key.touch(0o600)
    assert certificate_and_key(tmp_path / "cert.pem", key)
    key.chmod(0o644)
    with pytest.raises(UsageError, match=r"mode 644.*chmod 600"):
        certificate_and_key(tmp_path / "cert.pem", key)


def test_a_name_that_would_forge_a_log_line_logs_nobody_in(stranger, caplog):
    with caplog.at_level(logging.INFO, logger="worldpose.pages"):
        for who in ("Eve\n2026-01-01 Ada: 'POST /x': 200", "Eve\r", "\x1b[2J", "\ud800"):
            body = json.dumps({"who": who, "token": TOKEN})
            assert stranger.post("/api/login", content=body, headers=JSON).status_code == 422
        stranger.post("/api/x%0aAda: 'POST", json={})
    assert all(message.isprintable() for message in caplog.messages)
    assert not any(message.startswith("Ada") for message in caplog.messages)


JSON = {"content-type": "application/json"}


def test_a_body_that_is_too_long_or_of_unknown_length_is_refused(ada):
    long = ada.post(f"{MATCH}/runs", content=b" " * (BODY_BYTES + 1), headers=JSON)
    assert long.status_code == 413
    pieces = ada.post(f"{MATCH}/runs", content=iter([b"{", b"}"]), headers=JSON)
    assert pieces.status_code == 411


def test_listening_to_other_machines_needs_a_token_and_a_name():
    for keywords in ({"token": None, "names": ["host"]}, {"token": TOKEN, "names": []}):
        with pytest.raises(UsageError, match=r"--host 0\.0\.0\.0"):
            access_for("0.0.0.0", secure=False, **keywords)
    with pytest.raises(UsageError, match="16 characters"):
        access_for("127.0.0.1", token="short", names=(), secure=False)
    access = access_for("0.0.0.0", token=TOKEN, names=["review.example"], secure=True)
    assert "review.example" in access.hosts
    assert "0.0.0.0" not in access.hosts
    tokens = {access_for("::1", token=None, names=(), secure=False).token for _ in range(2)}
    assert len(tokens) == 2


def test_every_answer_forbids_what_pages_do_not_need(ada, stranger):
    asked = ((ada, "/"), (ada, "/api/matches"), (stranger, "/login"), (stranger, "/x"))
    for headers in (browser.get(path).headers for browser, path in asked):
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"


ASCENDING = ["%2e%2e", "..%2f..%2fetc", "%2Fetc%2Fpasswd", "....//", "..%5c..", "%00", "a/../b"]


def test_a_name_never_becomes_a_path(ada, tiny_run, tiny):
    opened = []

    def note(event, args):
        # The scheduler of other tests' runs has threads in this process, and reads its load.
        mine = threading.current_thread().name not in ("IO loop", "Profile")
        if event == "open" and listening and mine and not str(args[0]).startswith("/proc/"):
            opened.append(str(args[0]))

    listening = False
    sys.addaudithook(note)
    roots = ("/api/matches/{}", MATCH + "/pictures/{}", MATCH + "/pictures/{}/image")
    roots += (MATCH + "/reviews/{}/evidence", "/assets/{}", "/login/{}")
    paths = [root.format(name) for root in roots for name in ASCENDING]
    listening = True
    for path in paths:
        assert ada.get(path, follow_redirects=False).status_code in (400, 404, 405), path
    listening = False
    outside = [
        path
        for path in opened
        if not path.startswith((str(tiny_run), str(tiny), sys.prefix, sys.base_prefix))
        and not path.endswith((".py", ".pyc", ".so", ".nbi", ".nbc"))
    ]
    assert outside == []


def test_every_change_is_logged_with_who_and_what_came_of_it(project_copy, caplog):
    ada = page_client.log_in(page_client.served(project_copy), "Ada")
    name, was = a_click(ada)
    preview = f"{MATCH}/pictures/cam03/preview"
    caplog.clear()  # of the login, where another test has set the level
    with caplog.at_level(logging.INFO, logger="worldpose.pages"):
        ada.post(f"{MATCH}/corrections", json=moved(name, was, [was[0] + 1.0, was[1]]))
        ada.get(MATCH)
        ada.post(preview, json={"points": {}})  # changes nothing, with every move of a mouse
        ada.post(preview, json={"points": {}}, headers={"x-form-secret": ""})
        ada.post("/api/login", json={"who": "Eve", "token": TOKEN + "x"}, headers={"cookie": ""})
        ada.post("/api/login", json={"who": "Bob", "token": TOKEN}, headers={"cookie": ""})
    assert caplog.messages == [
        f"Ada: 'POST {MATCH}/corrections': 200",
        f"Ada: 'POST {preview}': 403",
        "nobody: 'POST /api/login': 401",
        "Bob: 'POST /api/login': 200",
    ]


USERS = """
[users.Vera]
role = "viewer"
token = "the token of Vera.."
[users.Ann]
role = "annotator"
token = "the token of Ann..."
[users."Åke Ö"]
role = "approver"
token = "the token of Åke..."
"""


def users_file(folder, text=USERS, mode=0o600):
    file = folder / "users.toml"
    file.write_text(text, encoding="utf-8")
    file.chmod(mode)
    return file


def test_people_of_a_file_may_do_what_their_role_says(store, tmp_path):
    def access(text=USERS):
        file = users_file(tmp_path, text)
        return access_for("127.0.0.1", token=TOKEN, names=(), secure=False, users=file)

    served = create_app(store.url, access())

    def enter(who, token):
        person = page_client.browser(served)
        answer = person.post("/api/login", json={"who": who, "token": token})
        if answer.status_code != 200:
            return None, None
        session = person.get("/api/session").json()
        assert session["who"] == who
        person.headers["x-form-secret"] = session["form_secret"]
        return person, session["role"]

    # The server's own token admits no user.
    for who, token in (("Vera", "the token of Ann..."), ("Vera", TOKEN), ("Eve", TOKEN)):
        assert enter(who, token) == (None, None)
    vera, role = enter("Vera", "the token of Vera..")
    assert role == "viewer"
    ann, role = enter("Ann", "the token of Ann...")
    assert role == "annotator"
    ake, role = enter("Åke Ö", "the token of Åke...")
    assert role == "approver"
    name, was = a_click(vera)
    edit = moved(name, was, [was[0] + 1.0, was[1]])
    refusal = vera.post(f"{MATCH}/corrections", json=edit)
    assert refusal.status_code == 403 and "viewer" in refusal.json()["error"]
    assert ann.post(f"{MATCH}/corrections", json=edit).status_code == 200
    *_, last = read_journal(store, TINY).records
    assert last.who == "Ann"
    assert {"/corrections", "/interpolation", "/acceptances"} <= set(EDITING)
    changing = {path for method, path in every_route(served) if method != "GET"} - OPEN
    for path in changing - {"/api/logout"}:
        is_preview = path.endswith("/preview")
        codes = [each.post(path, json={"no": 1}).status_code for each in (vera, ann, ake)]
        may = [is_preview, is_preview or path.endswith(EDITING), True]
        assert [code != 403 for code in codes] == may, path
    assert vera.get(MATCH).status_code == 200
    # A session ends with the person's entry, or with another token of the person.
    before = access()
    assert before.person(before.session("Eve")) is None
    session = before.session("Ann")
    assert before.person(session) == "Ann"
    for old, new in (("of Ann...", "of Ann, new"), ("Ann", "Anne")):
        assert access(USERS.replace(old, new)).person(session) is None


@pytest.mark.parametrize(
    ("text", "mode", "problem"),
    [
        (USERS, 0o640, "others can read"),
        ("[users.A]\nrole = 'king'\ntoken = 'a secret, long enough'", 0o600, "users.A.role"),
        ("[users.A]\nrole = 'viewer'\ntoken = 'short'", 0o600, "users.A.token"),
        ("users.A = secret", 0o600, "may hold a token"),
        (USERS.replace("of Ann...", "of Vera.."), 0o600, "same token"),
        (USERS.replace("Vera]", '"V\\n"]'), 0o600, "printed"),
    ],
)
def test_a_bad_file_of_users_is_refused_without_its_tokens(text, mode, problem, tmp_path):
    users = users_file(tmp_path, text, mode)
    with pytest.raises(UsageError, match=problem) as refusal:
        access_for("127.0.0.1", token=None, names=(), secure=False, users=users)
    assert "the token of" not in str(refusal.value) and "a secret" not in str(refusal.value)


def test_tls_pages_tell_browsers_to_stay_with_tls_except_on_this_machine(tmp_path):
    Store.create(str(tmp_path))
    names = ("review.example.org",)
    for secure, host, told in (
        (True, "review.example.org:8571", True),
        (True, "localhost:8571", False),
        (False, "review.example.org", False),
    ):
        access = access_for("127.0.0.1", token=TOKEN, names=names, secure=secure)
        browser = page_client.browser(create_app(str(tmp_path), access))
        answer = browser.get("/login", headers={"host": host})
        assert answer.status_code == 200
        assert ("strict-transport-security" in answer.headers) == told
