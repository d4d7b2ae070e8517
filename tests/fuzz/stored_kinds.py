"""Damage to a finished project, and requests to its pages that no page of ours sends."""

import json
import re
import shutil

import numpy as np
from fastapi.testclient import TestClient

from data_contracts.match import Registration
from flows.cli.project import _match_status
from flows.registering import open_match
from flows.review.verdicts import reviews_of, warnings_of
from flows.run_record import latest_run
from flows.web.access import access_for
from flows.web.app import create_app
from worldpose.store.documents import seal, unseal
from worldpose.store.garbage import plan_gc
from worldpose.store.integrity import repair, verify
from worldpose.store.store import Store, open_run

from .content_kinds import SPOILS
from .judging import run_match
from .kinds import add, mutation, one

MATCH, TOKEN = "fuzz", "a-token-of-twenty-four.."
PLACES = {
    "record": "runs/*/0001.json",
    "registration": "matches/*.json",
    "project": "project.json",
    "manifest": "results/*/*/*/*/manifest.json",
    "chunk": "results/*/*/*/*/**/c/**",
    "group": "results/*/*/*/*/**/zarr.json",
    "journal": "reviews/*/*.json",
}


class Project:
    """A copy of a finished project and its match, for damage; `asked` are bodies and bad names."""

    def __init__(self, template, work):
        self.root, self.folder, self.asked = work / "project", work / "match", []
        for name in ("project", "match"):
            shutil.copytree(template / name, work / name)
        for file in (self.root / "matches").glob("*.json"):  # it names the copy
            known = unseal(Registration, file.read_bytes(), str(file))
            file.write_bytes(seal(known.model_copy(update={"folder": str(self.folder)})))


@mutation
def spoil(project, rng, pattern, change):
    """Change one file of the store; None removes it."""
    files = sorted(path for path in project.root.glob(pattern) if path.is_file())
    if files and change is None:
        one(rng, files).unlink()
    elif files:
        file = one(rng, files)
        file.write_bytes(change(file.read_bytes() or b"x", rng))


def act(change):
    return lambda project, rng: change(project.root, project.folder)


STORE = {
    **{f"{p}_{n}": spoil(g, change) for p, g in PLACES.items() for n, change in SPOILS.items()},
    **{f"{p}_lost": spoil(g, None) for p, g in PLACES.items()},
    "results_lost": act(lambda root, match: shutil.rmtree(root / "results")),
    "runs_lost": act(lambda root, match: shutil.rmtree(root / "runs")),
    "staging_left": act(lambda root, match: (root / "staging/dead/c").mkdir(parents=True)),
    "reservation_of_the_dead": act(
        lambda root, match: (root / f"runs/{MATCH}/0002.open.json").write_text("{}")
    ),
    "record_of_huge_number": act(
        lambda root, match: shutil.copy(
            root / f"runs/{MATCH}/0001.json", root / f"runs/{MATCH}/{'9' * 40}.json"
        )
    ),
    "record_links_to_itself": act(
        lambda root, match: (root / f"runs/{MATCH}/0002.json").symlink_to("0002.json")
    ),
    "registration_is_a_folder": act(lambda root, match: (root / "matches/b.json").mkdir()),
    "match_folder_lost": act(lambda root, match: shutil.rmtree(match)),
    "match_yaml_lost": act(lambda root, match: (match / "match.yaml").unlink()),
    "project_of_a_later_format": act(
        lambda root, match: (root / "project.json").write_text(
            '{"checksum": "' + "0" * 64 + '", "contract": 9}'
        )
    ),
}
add("store", STORE, base="stored")


def use_store(project):
    """Everything that reads a project, as the command line does it: exceptions by command."""
    root = str(project.root)

    def status():
        store = Store.open(root)
        for match_id in store.matches():
            _match_status(store, match_id)

    def look():
        store = Store.open(root)
        match = open_match(store, MATCH)
        warnings_of(match)
        reviews_of(store, match, latest_run(store, MATCH))

    def read():
        run = open_run(root, MATCH)
        for name in ("triangulation/clip", "body_fitting/clip"):
            if name in run:
                np.isfinite(run[name]["joints"].values).sum()

    def mend():
        store = Store.open(root)
        plan_gc(store)
        repair(store, verify(store, progress=lambda done, total: None))

    def again():
        _, _, record, failures = run_match(project.folder, project.root, until="triangulation")
        if failures:
            raise failures[0][1]
        assert record.state == "complete"

    for command in (status, look, read, mend, again):
        try:
            command()
        except Exception as error:
            yield command.__name__, error


def edit_body(kind, **fields):
    """A request that makes one correction."""
    return json.dumps({"edits": [{"id": f"{kind}.000000000001", "edit": {"kind": kind, **fields}}]})


NUMBERS = {"negative": "-1", "huge": "9" * 30, "textual": "abc", "empty": ""}
BODIES = {
    "null": "null",
    "text": '"x"',
    "not_json": "{",
    "empty": "",
    "deep": "[" * 50000 + "]" * 50000,
    "bytes": b"\xff\xfe\x00",
    "surrogate": '{"who": "\\ud800", "token": "\\ud800"}',
    "login_of_number": '{"who": 7, "token": 8}',
    "too_large": '{"a": "' + "x" * 1_200_000 + '"}',
    "points_of_unknown_name": '{"points": {"moon": [1, 2]}}',
    "points_of_huge_number": '{"points": {"center_mark": [1e308, -1e308]}}',
    "drawn_empty": '{"drawn": {"halfway_line": []}}',
    "edits_of_unknown_kind": edit_body("x"),
    "edit_of_huge_detection": edit_body(
        "added_detection", camera="cam0", frame=0, detection=10**9, box=[0, 0, 10, 10]
    ),
    "tracks_of_huge_ids": edit_body("merged_tracks", clip="clip", kept=10**40, merged=-1),
    "accept_of_huge_frames": json.dumps({"people": [[10**30, 10**30]]}),
    "verdict_of_nothing": '{"verdict": ""}',
}
GOOD = {"match_id": MATCH, "owner": "cam0", "camera": "cam0", "clip": "clip", "number": "0"}
ask = {f"request_body_{n}": lambda p, r, v=v: p.asked.append((v, None)) for n, v in BODIES.items()}
ask |= {
    f"request_number_{n}": lambda p, r, v=v: p.asked.append(("{}", v)) for n, v in NUMBERS.items()
}
add("request", ask, base="stored")


def ask_all(project, rng):
    """Yield the pages' answers to a project's requests: what was asked, status, start of body."""
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    app = create_app(str(project.root), access)
    client = TestClient(app, base_url="http://127.0.0.1:8571", raise_server_exceptions=False)
    client.post("/api/login", json={"who": "Ada", "token": TOKEN})
    headers = {"x-form-secret": client.get("/api/session").json().get("form_secret", "")}
    paths = [(path, method) for path, known in app.openapi()["paths"].items() for method in known]
    paths = [each for each in paths if not re.search("continu|resume|/runs?$", each[0])]
    changing = [each for each in paths if each[1] != "get"]
    for body, number in project.asked:
        for _ in range(6):
            path, method = one(rng, changing if number is None else paths)
            holes = re.findall(r"{(\w+)[^}]*}", path)
            names = {hole: GOOD.get(hole, "x") for hole in holes}
            if number is not None and holes and rng.random() < 0.3:
                names[one(rng, holes)] = number
            url = re.sub(r"{(\w+)[^}]*}", lambda hole, names=names: names[hole[1]], path)
            if number is not None:
                url += f"?{one(rng, ['frame', 'number', 'person', 'first', 'limit'])}={number}"
            content = {} if method == "get" else {"content": body}
            kind = {"content-type": "application/json"}
            answer = client.request(method.upper(), url, headers={**headers, **kind}, **content)
            yield f"{method} {url[:80]}", answer.status_code, answer.text[:300]
