"""Damage to a store, and requests to the review pages that no page of ours sends."""

import json
import re
import shutil

import numpy as np

from .file_kinds import SPOILS, TEXTUAL
from .kinds import kinds, one

MATCH = "fuzz"
TOKEN = "a-token-of-twenty-four.."
HERE = "http://127.0.0.1:8571"


class Project:
    """A finished project, copied for damage, and the requests to its pages.

    Attributes:
        root: the store.
        folder: the match folder.
        asked: requests, each method, path and keywords.
    """

    def __init__(self, template, work):
        self.root, self.folder = work / "project", work / "match"
        shutil.copytree(template / "project", self.root)
        shutil.copytree(template / "match", self.folder)
        for file in (self.root / "matches").glob("*.json"):
            _move(file, str(template / "match"), str(self.folder))
        self.asked = []
        self.truth = None

    def files(self, pattern):
        return sorted(path for path in self.root.glob(pattern) if path.is_file())


def _move(file, old, new):
    """The registration of a copied match names the copy."""
    from data_contracts.match import Registration
    from worldpose.store.documents import seal, unseal

    known = unseal(Registration, file.read_bytes(), str(file))
    file.write_bytes(seal(known.model_copy(update={"folder": known.folder.replace(old, new)})))


# -------------------------------------------------------------------------------------- store

PLACES = {
    "record": "runs/*/0001.json",
    "registration": "matches/*.json",
    "project": "project.json",
    "manifest": "results/*/*/*/*/manifest.json",
    "chunk": "results/*/*/*/*/**/c/**",
    "group": "results/*/*/*/*/**/zarr.json",
    "journal": "reviews/*/*.json",
}


def _store_file(project, rng, how):
    pattern, change = how
    files = project.files(pattern)
    if files:
        file = one(rng, files)
        file.write_bytes(change(file.read_bytes() or b"x", rng))


for place, pattern in PLACES.items():
    kinds(
        "store",
        {
            f"{place}_{label}": (pattern, SPOILS[label])
            for label in SPOILS
            if not any(word in label for word in (*TEXTUAL, "nested", "10_mb", "bom", "crlf"))
        },
        _store_file,
        base="stored",
    )


def _store_lost(project, rng, pattern):
    files = project.files(pattern)
    if files:
        one(rng, files).unlink()


kinds(
    "store",
    {f"{place}_lost": pattern for place, pattern in PLACES.items()},
    _store_lost,
    base="stored",
)


def _store_act(project, rng, act):
    act(project)


def _rename(project, old, new):
    if (project.root / old).exists():
        (project.root / old).rename(project.root / new)


kinds(
    "store",
    {
        "results_lost": lambda p: shutil.rmtree(p.root / "results"),
        "runs_lost": lambda p: shutil.rmtree(p.root / "runs"),
        "staging_left": lambda p: (p.root / "staging" / "dead" / "c").mkdir(parents=True),
        "match_under_another_name": lambda p: _rename(p, f"matches/{MATCH}.json", "matches/b.json"),
        "reservation_of_the_dead": lambda p: (p.root / f"runs/{MATCH}/0002.open.json").write_text(
            "{}"
        ),
        "record_of_huge_number": lambda p: shutil.copy(
            p.root / f"runs/{MATCH}/0001.json", p.root / f"runs/{MATCH}/{'9' * 40}.json"
        ),
        "registration_is_a_folder": lambda p: (p.root / "matches/b.json").mkdir(),
        "record_links_to_itself": lambda p: (p.root / f"runs/{MATCH}/0002.json").symlink_to(
            "0002.json"
        ),
        "match_folder_lost": lambda p: shutil.rmtree(p.folder),
        "match_yaml_lost": lambda p: (p.folder / "match.yaml").unlink(),
        "match_yaml_of_another_match": lambda p: (p.folder / "match.yaml").write_text(
            (p.folder / "match.yaml").read_text().replace("fuzz", "other")
        ),
        "project_of_a_later_format": lambda p: (p.root / "project.json").write_text(
            '{"checksum": "' + "0" * 64 + '", "contract": 9}'
        ),
    },
    _store_act,
    base="stored",
)


def use_store(project):
    """Everything that reads a project, as the command line does it: exceptions by command."""
    from flows.cli.project import _match_status
    from flows.registering import open_match
    from flows.review.verdicts import reviews_of, warnings_of
    from flows.run_record import latest_run
    from worldpose.store.garbage import plan_gc
    from worldpose.store.integrity import repair, verify
    from worldpose.store.store import Store, open_run

    from .judging import run_match

    def status():
        store = Store.open(str(project.root))
        for match_id in store.matches():
            _match_status(store, match_id)

    def check():
        verify(Store.open(str(project.root)), progress=lambda done, total: None)

    def collect():
        plan_gc(Store.open(str(project.root)))

    def look():
        store = Store.open(str(project.root))
        match = open_match(store, MATCH)
        warnings_of(match)
        reviews_of(store, match, latest_run(store, MATCH))

    def read():
        run = open_run(str(project.root), MATCH)
        for name in ("triangulation/clip", "body_fitting/clip"):
            if name in run:
                np.isfinite(run[name]["joints"].values).sum()

    def mend():
        store = Store.open(str(project.root))
        repair(store, verify(store, progress=lambda done, total: None))

    def again():
        _, _, record, failures = run_match(project.folder, project.root, until="triangulation")
        if failures:
            raise failures[0][1]
        assert record.state == "complete"

    raised = []
    for command in (status, check, collect, look, read, mend, again):
        try:
            command()
        except Exception as error:
            raised.append((command.__name__, error))
    return raised


# ------------------------------------------------------------------------------------ requests

NUMBERS = {"negative": "-1", "huge": "9" * 30, "textual": "abc", "empty": ""}


def edit_body(kind, **fields):
    """A request that makes one correction."""
    entry = {"id": f"{kind}.000000000001", "edit": {"kind": kind, **fields}}
    return json.dumps({"edits": [entry]})


DEEP = "[" * 50000 + "]" * 50000
BODIES = {
    "null": "null",
    "mapping": "{}",
    "text": '"x"',
    "not_json": "{",
    "empty": "",
    "deep": DEEP,
    "bytes": b"\xff\xfe\x00",
    "surrogate": '{"who": "\\ud800", "token": "\\ud800"}',
    "token_of_unicode": '{"who": "Ada", "token": "\u00e9\u4e16"}',
    "login_of_number": '{"who": 7, "token": 8}',
    "large": '{"a": "' + "x" * 900_000 + '"}',
    "too_large": '{"a": "' + "x" * 1_200_000 + '"}',
    "points_of_unknown_name": '{"points": {"moon": [1, 2]}}',
    "points_of_huge_number": '{"points": {"center_mark": [1e308, -1e308]}}',
    "points_many": json.dumps({"points": {f"p{n}": [n, n] for n in range(250)}}),
    "drawn_empty": '{"drawn": {"halfway_line": []}}',
    "refine": '{"points": {"center_mark": [5, 5]}, "refine": true}',
    "edits_of_unknown_kind": '{"edits": [{"id": "x.000000000001", "edit": {"kind": "x"}}]}',
    "edit_of_huge_detection": edit_body(
        "added_detection", camera="cam0", frame=0, detection=10**9, box=[0, 0, 10, 10]
    ),
    "edit_of_huge_pixel": edit_body(
        "moved_point", camera="cam0", marking="center_mark", xy=[1e300, 2]
    ),
    "tracks_of_huge_ids": edit_body("merged_tracks", clip="clip", kept=10**40, merged=-1),
    "accept_of_huge_frames": json.dumps({"people": [[10**30, 10**30]]}),
    "verdict_of_nothing": '{"verdict": ""}',
}
GOOD = {"match_id": MATCH, "owner": "cam0", "camera": "cam0", "clip": "clip", "number": "0"}
ROUTES = []


def routes(app):
    """Methods and paths of a server, in order; those that begin runs are left alone."""
    found = {
        (method.upper(), path)
        for path, methods in app.openapi()["paths"].items()
        for method in methods
    }
    return sorted(each for each in found if not re.search("continu|resume|/runs?$", each[1]))


def _path(rng, path, bad=None):
    """The path with good names, one of them replaced by a bad one."""
    holes = re.findall(r"{(\w+)[^}]*}", path)
    spoilt = one(rng, holes) if bad is not None and holes else None
    for hole in holes:
        value = bad if hole == spoilt else GOOD.get(hole, "x")
        path = re.sub(r"{" + hole + r"[^}]*}", lambda _, value=value: value, path)
    return path


def _ask(project, rng, how):
    kind, value = how
    choices = ROUTES
    if kind == "body":
        choices = [each for each in ROUTES if each[0] in ("POST", "PUT", "DELETE")]
    for _ in range(6):
        method, path = one(rng, choices)
        keywords, url = {}, _path(rng, path)
        if kind == "number":
            key = one(rng, ["frame", "number", "person", "first", "limit"])
            url = f"{_path(rng, path, value if rng.random() < 0.3 else None)}?{key}={value}"
        if method in ("POST", "PUT", "DELETE", "PATCH"):
            keywords["content"] = value if kind == "body" else '{"edits": []}'
            keywords["headers"] = {"content-type": "application/json"}
        project.asked.append((method, url, keywords))


for label, value in NUMBERS.items():
    kinds("request", {f"request_number_{label}": ("number", value)}, _ask, base="stored")
for label, value in BODIES.items():
    kinds("request", {f"request_body_{label}": ("body", value)}, _ask, base="stored")


def ask_all(project):
    """Return the pages' answers to a project's requests: method, path, status, start of body."""
    from fastapi.testclient import TestClient

    from flows.web.access import access_for
    from flows.web.app import create_app

    app = create_app(
        str(project.root), access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    )
    client = TestClient(app, base_url=HERE, raise_server_exceptions=False)
    login = client.post("/api/login", json={"who": "Ada", "token": TOKEN})
    secret = client.get("/api/session").json()["form_secret"] if login.status_code == 200 else ""
    answers = []
    for method, path, keywords in project.asked:
        headers = {"x-form-secret": secret, **(keywords.pop("headers", None) or {})}
        try:
            answer = client.request(method, path, headers=headers, **keywords)
        except (
            ValueError,
            TypeError,
            UnicodeError,
        ) as error:  # the client itself refuses to send it
            answers.append((method, path[:80], 0, f"not sent: {error}"[:200]))
            continue
        answers.append((method, path[:80], answer.status_code, answer.text[:300]))
    return answers
