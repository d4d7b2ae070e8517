"""A proxy in front of the pages logs people in, and only the named one is believed."""

import time

import httpx
import page_client
import pytest
from command_line import TINY
from page_client import HERE, MATCH, TOKEN, TestClient, moved

from flows.web.access import access_for
from flows.web.app import create_app
from worldpose.errors import UsageError
from worldpose.review.journal import read_journal

SECRET = "a secret of the proxy"
FILE = f"""
[users.Root]
role = "approver"
token = "the token of Root.."
[proxy]
addresses = ["127.0.0.1", "10.1.0.0/16", "fd00::/8"]
secret = "{SECRET}"
sign_out = "/oauth2/sign_out"
[proxy.roles]
directors = "approver"
"data team" = "annotator"
staff = "viewer"
"""
GROUPS = {"Dora": "staff,directors", "Tom": "data team", "Ömer": "staff", "Guest": "guests"}
"""People and their groups at the provider."""


def write_file(folder, text=FILE):
    file = folder / "users.toml"
    file.write_text(text, encoding="utf-8")
    file.chmod(0o600)
    return file


@pytest.fixture
def pages(store, tmp_path):
    users = write_file(tmp_path)
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=False, users=users)
    return create_app(store.url, access)


def client(app, address="10.1.2.3"):
    return TestClient(app, base_url=HERE, client=(address, 50000))


def named(who, groups=None, secret=SECRET):
    headers = {"X-Forwarded-User": who.encode(), "X-Forwarded-Groups": groups or GROUPS[who]}
    return {**headers, "X-Proxy-Secret": secret} if secret else headers


def test_the_proxy_tells_person_and_role(pages, store):
    dora = client(pages)
    opened = dora.get("/", headers=named("Dora"))
    assert opened.status_code == 200 and "HttpOnly" in opened.headers["set-cookie"]
    assert "Secure" not in opened.headers["set-cookie"]
    session = dora.get("/api/session", headers=named("Dora"))
    assert "set-cookie" not in session.headers
    assert (session.json()["who"], session.json()["role"]) == ("Dora", "approver")
    secret = {"x-form-secret": session.json()["form_secret"]}
    points = dora.get(f"{MATCH}/pictures/cam03", headers=named("Dora")).json()["points"]
    name, (x, y) = min(points.items())
    edit, path = moved(name, [x, y], [x + 1.0, y]), f"{MATCH}/corrections"
    assert dora.post(path, json=edit, headers={**named("Dora"), **secret}).status_code == 200
    *_, last = read_journal(store, TINY).records
    assert last.who == "Dora"
    # A group that was taken away counts from the next request on.
    refused = dora.post(path, json=edit, headers={**named("Dora", "staff"), **secret})
    assert refused.status_code == 403 and "viewer" in refused.json()["error"]
    assert dora.get("/login", headers=named("Dora"), follow_redirects=False).status_code == 303
    left = dora.post("/api/logout", json={}, headers={**named("Dora"), **secret})
    assert left.json() == {"next": "/oauth2/sign_out"}


def test_roles_are_the_highest_of_the_groups(pages):
    found = {}
    for who in GROUPS:
        answer = client(pages).get("/api/session", headers=named(who))
        found[who] = answer.json().get("role", answer.json().get("error"))
    assert found == {
        "Dora": "approver",
        "Tom": "annotator",
        "Ömer": "viewer",
        "Guest": "none of the groups of Guest has a role here",
    }
    tls = client(pages).get("/", headers={**named("Dora"), "X-Forwarded-Proto": "https"})
    assert "Secure" in tls.headers["set-cookie"]


NOBODY = [
    ("10.2.0.1", named("Dora")),
    ("fe80::1", named("Dora")),
    ("testclient", named("Dora")),
    ("10.1.2.3", named("Dora", secret=None)),
    ("127.0.0.1", named("Dora", secret="a secret of the proxi")),
    ("127.0.0.1", named("Dora", secret="")),
    ("10.1.2.3", {**named("Dora"), "X-Forwarded-User": ""}),
    ("10.1.2.3", {**named("Dora"), "X-Forwarded-User": "D" * 81}),
    ("10.1.2.3", {**named("Dora"), "X-Forwarded-User": "D\u200bora".encode()}),
    ("10.1.2.3", [*named("Tom").items(), ("X-Forwarded-User", "Dora")]),  # two names are none
]


def test_who_is_not_the_named_proxy_names_nobody(pages):
    for address, headers in NOBODY:
        visitor = client(pages, address)
        assert visitor.get("/api/session", headers=headers).status_code == 401
        forged = [*dict(headers).items(), ("X-Forwarded-For", "10.1.2.3")]
        if isinstance(headers, dict):
            assert visitor.get("/api/session", headers=forged).status_code == 401


def test_a_session_of_the_proxy_opens_nothing_past_it(pages):
    dora = client(pages)
    cookie = dora.get("/", headers=named("Dora")).headers["set-cookie"].partition(";")[0]
    past = client(pages, "127.0.0.1")
    assert past.get("/api/session", headers={"cookie": cookie}).status_code == 401
    # Nor does a person's own session become one of another person.
    tom = client(pages).get("/api/session", headers={**named("Tom"), "cookie": cookie})
    assert tom.json()["who"] == "Tom" and "set-cookie" in tom.headers
    # A person of the file still logs in with a token.
    root = client(pages, "127.0.0.1")
    said = {"who": "Root", "token": "the token of Root.."}
    assert root.post("/api/login", json=said).status_code == 200
    assert root.get("/api/session").json()["role"] == "approver"


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (f'secret = "{SECRET}"', "", "needs a secret"),
        (SECRET, "short", "proxy.secret"),
        ('"10.1.0.0/16"', '"10.1.0.0/99"', "proxy.addresses"),
        ('directors = "approver"', 'directors = "king"', "proxy.roles"),
        ("/oauth2/sign_out", "//evil.example/", "proxy.sign_out"),
        ("sign_out", "logout", "proxy.logout"),
    ],
)
def test_a_bad_table_of_the_proxy_is_refused(old, new, problem, tmp_path):
    assert old in FILE
    file = write_file(tmp_path, FILE.replace(old, new))
    with pytest.raises(UsageError, match=problem) as refusal:
        access_for("127.0.0.1", token=None, names=(), secure=False, users=file)
    assert SECRET not in str(refusal.value)


def test_another_address_named_by_a_client_does_not_allow_more_guesses(project_copy, tmp_path):
    with page_client.serving(project_copy, tmp_path) as base:
        wrong, begun = {"who": "Eve", "token": TOKEN + "x"}, time.monotonic()
        claims = [{"X-Forwarded-For": f"10.0.0.{number}"} for number in range(8)]
        answers = [httpx.post(f"{base}/api/login", json=wrong, headers=each) for each in claims]
        assert time.monotonic() - begun < 10.0, "too slow to tell"
        assert [answer.status_code for answer in answers] == [401] * 5 + [429] * 3
