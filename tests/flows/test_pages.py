"""The pages' server lets in who it should, keeps what people say, and overwrites nobody."""

import logging
import shutil
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_line import TINY

from data_contracts.conventions import COCO17
from flows import corrections
from flows.pages import continuing
from flows.pages.access import SESSION_SECONDS, access_for
from flows.pages.app import create_app
from flows.pages.continuing import Continuing
from flows.pages.guard import BODY_BYTES, OPEN
from flows.planning import plan_run
from flows.registering import open_match, register
from flows.running import RunRequest, run_match
from tasks.ingest import ingest
from worldpose.errors import StoreError, UsageError
from worldpose.review import read_journal
from worldpose.store import Store, open_run

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the web framework, about its own test client
    from fastapi.testclient import TestClient

TOKEN = "a token of twenty-four.."
HERE = "http://127.0.0.1:8571"
MATCH = f"/api/matches/{TINY}"


@pytest.fixture
def app(project_copy):
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    app = create_app(str(project_copy), access)
    app.state.access = access
    return app


@pytest.fixture
def stranger(app):
    """A browser that has not logged in."""
    return TestClient(app, base_url=HERE)


def log_in(app, who):
    browser = TestClient(app, base_url=HERE)
    assert browser.post("/api/login", json={"who": who, "token": TOKEN}).status_code == 200
    secret = browser.get("/api/session").json()["form_secret"]
    browser.headers["x-form-secret"] = secret
    return browser


@pytest.fixture
def ada(app):
    return log_in(app, "Ada")


@pytest.fixture
def bob(app):
    return log_in(app, "Bob")


def every_route(app):
    """Method and path of every route of the server, from the server itself."""
    names = {"match_id": TINY, "owner": "cam00", "request": "r", "number": "0", "clip": "clip"}
    for path, methods in app.openapi()["paths"].items():
        for method in methods:
            yield method.upper(), path.format_map(names)


def refused(browser, method, path, **keywords):
    return browser.request(method, path, follow_redirects=False, **keywords)


def test_every_route_but_log_in_and_health_refuses_a_stranger(app, stranger):
    routes = list(every_route(app))
    assert {path for _, path in routes} >= {MATCH, f"{MATCH}/decisions", "/", "/api/session"}
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
    forged = [
        f"{packed}.{signature[:-1]}{last}",
        f"{packed[:-2]}.{signature}",
        other.session("Ada"),
    ]
    for cookie in [*forged, over, "", ".", "%%", "é"]:
        assert access.person(cookie) is None
    for cookie in (forged[0], over):
        answer = stranger.get(MATCH, headers={"cookie": f"{access.cookie}={cookie}"})
        assert answer.status_code == 401
    assert access.person(good) == "Ada"
    assert access.person(access.session("Ada", now=0.0), now=SESSION_SECONDS - 1.0) == "Ada"


def test_the_cookie_is_out_of_reach_of_scripts_and_of_other_sites(project_copy, stranger):
    cookie = stranger.post("/api/login", json={"who": "Ada", "token": TOKEN}).headers["set-cookie"]
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))
    assert "Secure" not in cookie
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=True)
    browser = TestClient(create_app(str(project_copy), access), base_url=HERE)
    cookie = browser.post("/api/login", json={"who": "A", "token": TOKEN}).headers["set-cookie"]
    assert "Secure" in cookie


def test_a_change_needs_the_form_secret_json_and_this_origin(ada, project_copy):
    before = read_journal(Store.open(str(project_copy)), TINY).entries
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
    assert read_journal(Store.open(str(project_copy)), TINY).entries == before
    assert "access-control-allow-origin" not in ada.get("/api/matches").headers


def test_nothing_is_changed_by_getting(app):
    changing = {path for method, path in every_route(app) if method == "POST"}
    getting = {path for method, path in every_route(app) if method == "GET"}
    assert changing.isdisjoint(getting)


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8571", "127.0.0.1.evil.example", ""]
)
def test_a_name_that_leads_here_by_rebinding_is_refused(ada, host):
    assert ada.get("/api/matches", headers={"host": host}).status_code == 421
    assert ada.get("/api/health", headers={"host": host}).status_code == 421


def test_a_body_that_is_too_long_or_of_unknown_length_is_refused(ada):
    long = ada.post(f"{MATCH}/runs", content=b" " * (BODY_BYTES + 1), headers=JSON)
    assert long.status_code == 413
    pieces = ada.post(f"{MATCH}/runs", content=iter([b"{", b"}"]), headers=JSON)
    assert pieces.status_code == 411


JSON = {"content-type": "application/json"}


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
    for browser, path in (
        (ada, "/"),
        (ada, "/api/matches"),
        (stranger, "/login"),
        (stranger, "/x"),
    ):
        policy = browser.get(path).headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert browser.get(path).headers["x-content-type-options"] == "nosniff"


def test_no_page_asks_anything_of_another_server():
    for file in Path(corrections.__file__).parent.glob("pages/*/**/*.*"):
        if file.suffix in (".html", ".css"):
            assert "//" not in file.read_text().replace("<!--", ""), file


ASCENDING = [
    "%2e%2e",
    "..%2f..%2fetc",
    "%2Fetc%2Fpasswd",
    "....//",
    "..%5c..",
    "%00",
    "a/../b",
]


@pytest.mark.parametrize("name", ASCENDING)
def test_a_name_never_becomes_a_path(ada, name, project_copy, tiny):
    opened = []
    sys.addaudithook(
        lambda event, args: opened.append(str(args[0])) if event == "open" and listening else None
    )
    paths = [
        f"/api/matches/{name}",
        f"{MATCH}/pictures/{name}",
        f"{MATCH}/pictures/{name}/image",
        f"{MATCH}/reviews/{name}/evidence",
        f"/assets/{name}",
        f"/login/{name}",
    ]
    listening = True
    for path in paths:
        assert ada.get(path, follow_redirects=False).status_code in (400, 404, 405), path
    listening = False
    outside = [
        path
        for path in opened
        if not path.startswith((str(project_copy), str(tiny), sys.prefix, sys.base_prefix))
        and not path.endswith((".py", ".pyc", ".so", ".nbi", ".nbc"))
    ]
    assert outside == []


def a_click(browser, camera="cam03"):
    clicked = browser.get(f"{MATCH}/pictures/{camera}").json()["points"]
    return next(iter(sorted(clicked.items())))


def moved(name, was, xy, number=1, camera="cam03"):
    edit = {"kind": "moved_point", "camera": camera, "marking": name, "was": was, "xy": xy}
    return {"edits": [{"id": f"moved_point.{number:012x}", "edit": edit}]}


def test_a_correction_is_kept_with_who_and_shown_to_all(ada, bob, project_copy):
    name, was = a_click(ada)
    answer = ada.post(f"{MATCH}/corrections", json=moved(name, was, [was[0] + 1.5, was[1]]))
    assert answer.status_code == 200, answer.text
    assert bob.get(f"{MATCH}/pictures/cam03").json()["points"][name] == [was[0] + 1.5, was[1]]
    (kept,) = open_match(Store.open(str(project_copy)), TINY).corrections
    assert (kept.who, kept.edit.marking) == ("Ada", name)


def test_an_edit_of_what_somebody_changed_meanwhile_gets_the_difference(ada, bob, project_copy):
    name, was = a_click(ada)
    theirs, mine = [was[0] + 2.0, was[1]], [was[0] - 3.0, was[1]]
    assert bob.post(f"{MATCH}/corrections", json=moved(name, was, theirs, 1)).status_code == 200
    answer = ada.post(f"{MATCH}/corrections", json=moved(name, was, mine, 2))
    assert answer.status_code == 409
    difference = answer.json()["difference"]
    assert (difference["was"], difference["now"], difference["who"]) == (was, theirs, "Bob")
    assert difference["marking"] == name
    # Another point of the same camera is nobody's business but hers.
    clicked = ada.get(f"{MATCH}/pictures/cam03").json()["points"]
    other = max(clicked)
    assert other != name
    place = clicked[other]
    assert ada.post(
        f"{MATCH}/corrections", json=moved(other, place, [place[0], place[1] - 1.0], 3)
    ).is_success
    assert ada.post(f"{MATCH}/corrections", json=moved(name, theirs, mine, 4)).is_success
    assert len(open_match(Store.open(str(project_copy)), TINY).corrections) == 3


def test_an_edit_that_was_kept_but_not_acknowledged_is_kept_once(ada, project_copy, monkeypatch):
    name, was = a_click(ada)
    edit = moved(name, was, [was[0] + 1.0, was[1]])
    keep = corrections.append

    def cut_off(store, journal, records):
        keep(store, journal, records)
        raise StoreError("cut off after the entry was durable")

    monkeypatch.setattr(corrections, "append", cut_off)
    assert ada.post(f"{MATCH}/corrections", json=edit).status_code == 500
    monkeypatch.setattr(corrections, "append", keep)
    assert ada.post(f"{MATCH}/corrections", json=edit).status_code == 200
    assert len(open_match(Store.open(str(project_copy)), TINY).corrections) == 1


def test_edits_are_kept_all_or_none(ada, project_copy):
    name, was = a_click(ada)
    both = moved(name, was, [was[0] + 1.0, was[1]])
    both["edits"] += moved("no_such_point", None, [5.0, 5.0], 2)["edits"]
    answer = ada.post(f"{MATCH}/corrections", json=both)
    assert (answer.status_code, "no_such_point" in answer.text) == (422, True)
    assert read_journal(Store.open(str(project_copy)), TINY).entries == ()


def test_a_keypoint_that_is_taken_out_is_gone_from_all_that_follows(ada, bob, project_copy):
    store = Store.open(str(project_copy))
    seen = open_run(str(project_copy), TINY)["ingest/cam00"]
    frame, joint = int(seen["frame"].values[3]), COCO17.index("left_wrist")
    detection = int(np.argmax(np.isfinite(seen["keypoints"].values[3, :, joint, 0])))
    was = seen["keypoints"].values[3, detection, joint].astype(float).tolist()
    place = {"camera": "cam00", "frame": frame, "detection": detection, "joint": "left_wrist"}
    edit = {"kind": "moved_keypoint", **place, "was": was, "xy": None}
    before = {each.name: each.key for each in plan_run(store, open_match(store, TINY), {})}
    keep = {"edits": [{"id": "moved_keypoint.1", "edit": edit}]}
    assert ada.post(f"{MATCH}/corrections", json=keep).status_code == 200
    again = {"edits": [{"id": "moved_keypoint.2", "edit": edit}]}
    answer = bob.post(f"{MATCH}/corrections", json=again)
    assert (answer.status_code, "is not seen" in answer.text) == (409, True)
    shown = ada.get(f"{MATCH}/detections/cam00", params={"frame": frame}).json()["people"]
    (person,) = (each for each in shown if each["detection"] == detection)
    assert person["keypoints"][joint] is None
    assert person["keypoints"][0] is not None
    match = open_match(store, TINY)
    units = {each.name: each for each in plan_run(store, match, {})}
    changed = {name for name, unit in units.items() if unit.key != before[name]}
    assert {"ingest/cam00", "tracking/clip", "bundle_adjustment/cameras"} <= changed
    assert not changed & {"ingest/cam01", "static_calibration/cam00"}
    unit = units["ingest/cam00"]
    ingest.fn(unit.work(store.url, match, "0001"))
    found = store.open_result(TINY, "ingest", "cam00", unit.key)["keypoints"].values
    gone = np.isnan(found) & np.isfinite(seen["keypoints"].values)
    assert np.argwhere(gone).tolist() == [[3, detection, joint, 0], [3, detection, joint, 1]]
    assert store.manifest(TINY, "ingest", "cam00", unit.key).figures["corrections_refused"] == 0


@pytest.fixture
def going_on(monkeypatch):
    asked = []
    monkeypatch.setattr(
        Continuing,
        "go_on",
        lambda self, name, gates=None: asked.append(name) or {"state": "running"},
    )
    return asked


def waiting(store):
    run_match(store, open_match(store, TINY), RunRequest({}, gates="auto"))


def test_the_run_goes_on_when_the_last_question_is_approved(ada, bob, project_copy, going_on):
    waiting(Store.open(str(project_copy)))
    reviews = ada.get(MATCH).json()["reviews"]
    assert len(reviews) > 1
    (row,) = (each for each in ada.get("/api/matches").json()["matches"] if each["match"] == TINY)
    assert len(row["waiting"]) == len(reviews)
    assert max(each["excess"] for each in row["waiting"]) > 0
    for number, each in enumerate(reviews):
        verdict = {"reviews": [each["id"]], "verdict": "approve", "seen": {each["id"]: "waits"}}
        answer = ada.post(f"{MATCH}/decisions", json=verdict)
        assert answer.json()["waiting"] == len(reviews) - number - 1
    assert going_on == [TINY]
    # Bob's page still shows the question.
    answer = bob.post(f"{MATCH}/decisions", json={**verdict, "verdict": "reject", "why": "no"})
    assert answer.status_code == 409
    assert (answer.json()["difference"]["now"], answer.json()["difference"]["who"]) == (
        "approve",
        "Ada",
    )
    assert (
        run_match(
            Store.open(str(project_copy)),
            open_match(Store.open(str(project_copy)), TINY),
            RunRequest({}, gates="auto"),
        ).state
        == "complete"
    )


def test_a_run_that_is_answered_while_it_ends_is_run_once_more(project_copy, tmp_path, monkeypatch):
    ran, gate = tmp_path / "ran", tmp_path / "gate"
    ran.touch()
    script = (
        "import pathlib, sys, time\n"
        f"open({str(ran)!r}, 'a').write(sys.argv[1] + '\\n')\n"
        f"while not pathlib.Path({str(gate)!r}).exists(): time.sleep(0.01)\n"
    )
    monkeypatch.setattr(continuing, "_COMMAND", [sys.executable, "-c", script])
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    runs = Continuing(Store.open(str(project_copy)))
    for _ in range(3):  # the second and third come while the first is at work
        assert runs.go_on(TINY)["state"] == "running"
    gate.touch()
    end = time.monotonic() + 60.0
    while ran.read_text().splitlines() != [TINY, TINY] or runs.state(TINY)["state"] != "ended":
        assert time.monotonic() < end
        time.sleep(0.02)
    assert runs.state(TINY)["code"] == 0


def test_an_empty_verdict_approves_nothing(ada, project_copy, going_on):
    waiting(Store.open(str(project_copy)))
    name = ada.get(MATCH).json()["reviews"][0]["id"]
    for body in ({}, {"reviews": [name]}, {"reviews": [name], "verdict": "", "seen": {}}):
        assert ada.post(f"{MATCH}/decisions", json=body).status_code == 422
    nothing = {"reviews": [], "verdict": "approve", "seen": {}}
    assert ada.post(f"{MATCH}/decisions", json=nothing).status_code == 422
    assert going_on == []


def test_the_preview_is_a_camera_or_says_what_to_click(ada):
    clicked = ada.get(f"{MATCH}/pictures/cam00").json()["points"]
    few = dict(list(clicked.items())[:2])
    path = f"{MATCH}/pictures/cam00/preview"
    advice = ada.post(path, json={"points": few}).json()
    assert advice["camera"] is None
    assert advice["todo"]
    found = ada.post(path, json={"points": clicked}).json()
    assert {each["name"] for each in found["residuals"]} == set(clicked)
    # Where the camera puts a click that it rests on is where it was clicked, less its residual.
    for each in found["residuals"]:
        expected = [a + b for a, b in zip(clicked[each["name"]], each["residual"], strict=True)]
        # Sent to a hundredth of a pixel, residuals to a thousandth.
        assert found["points"][each["name"]] == pytest.approx(expected, abs=0.011)
    assert 0 < found["median"] < found["p95"]
    assert len(found["markings"]) > 3


def test_every_change_is_logged_with_who_and_what_came_of_it(ada, caplog):
    name, was = a_click(ada)
    with caplog.at_level(logging.INFO, logger="worldpose.pages"):
        ada.post(f"{MATCH}/corrections", json=moved(name, was, [was[0] + 1.0, was[1]]))
        ada.get(MATCH)
    assert caplog.messages == [f"Ada: 'POST {MATCH}/corrections': 200"]


def test_a_match_that_nobody_clicked_is_clicked_from_nothing(
    app, ada, project_copy, tiny, tmp_path
):
    folder = Path(shutil.copytree(tiny, tmp_path / "match"))
    file = folder / "match.yaml"
    file.write_text(file.read_text().replace(TINY, "new"))
    (folder / "annotations" / "static_calibration" / "cam00.json").unlink()
    detections = folder / "detections"
    spare = min(detections.iterdir())
    shutil.copy(max(detections.iterdir()), spare)  # another match's content
    store = Store.open(str(project_copy))
    register(store, folder, unfinished=True)
    path = "/api/matches/new"
    assert ada.get(path).json()["to_click"] == ["cam00"]
    assert ada.get(f"{path}/pictures/cam00").json()["points"] == {}
    edit = moved("center_mark", None, [900.0, 500.0], camera="cam00")
    assert ada.post(f"{path}/corrections", json=edit).is_success
    assert ada.get(f"{path}/pictures/cam00").json()["points"] == {"center_mark": [900.0, 500.0]}
    assert ada.get(path).json()["to_click"] == []
