"""Cases: which kinds strike together, and one case from its beginning to its outcome."""

import os
import shutil
import tempfile
import zlib
from pathlib import Path

import numpy as np

from . import (  # noqa: F401 - they register
    camera_kinds,
    click_kinds,
    file_kinds,
    people_kinds,
    service_kinds,
)
from .judging import DEFECTS, REFUSED, RIGHT, UNJUDGED, failure_class, judge, leftovers, run_match
from .kinds import DATA, FILES, FILM, KINDS
from .scene import film, new_draft, write
from .service_kinds import ROUTES, Project, ask_all, routes, use_store

WEIGHTS = {
    **{"camera": 3, "clicks": 4, "people": 4, "clips": 3, "toml": 3, "pitch": 2},
    **{"ids": 1, "bytes": 3, "video": 1, "store": 2, "request": 2},
}
"""How often a case begins with a kind of each group: what reaches the stages comes more often."""
FURTHER = ("camera", "clicks", "people", "clips", "toml", "pitch")
"""Groups from which most further kinds of a combination come: others end most matches at once."""


def draw_case(seed, number):
    """The kinds of a case and its seed: one of a group, joined by up to three more in half of all.

    The kinds of a group come in turn, in an order that the seed decides.
    """
    names = sorted(KINDS)
    rng = np.random.default_rng([seed, number])
    groups = sorted(WEIGHTS)
    share = np.array([WEIGHTS[group] for group in groups], dtype=float)
    group = str(rng.choice(groups, p=share / share.sum()))
    of_group = [name for name in names if KINDS[name].group == group]
    order = np.random.default_rng([seed, groups.index(group)]).permutation(len(of_group))
    chosen = [of_group[order[number % len(of_group)]]]
    wanted = 1 if rng.random() < 0.5 else int(rng.integers(2, 5))
    for _ in range(40):
        if len(chosen) == wanted:
            break
        pool = names
        if KINDS[chosen[0]].base != "stored" and rng.random() < 0.8:
            pool = [name for name in names if KINDS[name].group in FURTHER]
        further = str(rng.choice(pool))
        if further not in chosen and base_of([*chosen, further]) is not None:
            chosen.append(further)
    return chosen, int(rng.integers(2**31))


def case_name(names, seed):
    """As `--case` takes it."""
    return f"{'+'.join(names)}:{seed}"


def parse_case(text):
    """Kinds and seed of a name."""
    names, _, seed = text.rpartition(":")
    return names.split("+"), int(seed)


def base_of(names):
    """The match that kinds need: any, clicked, given, filmed or stored; None if none suits all."""
    bases = {KINDS[name].base for name in names} - {"any"}
    groups = {KINDS[name].group for name in names}
    if len(bases) > 1:
        return None
    if bases == {"stored"} and not groups <= {"store", "request"}:
        return None
    if bases == {"filmed"} and groups - {"video", "ids"}:
        return None
    return bases.pop() if bases else "any"


def build(names, seed):
    """The draft of a case, spoilt; and whether its result must be right."""
    rng = np.random.default_rng([seed, zlib.crc32("+".join(names).encode())])
    base = base_of(names)
    chosen = [KINDS[name] for name in names]
    if base == "any":
        base = str(rng.choice(["clicked", "given"]))
    draft = new_draft(rng, base == "clicked")
    if base == "filmed":
        small_images(draft)
    for kind in chosen:
        if kind.phase == FILM:
            kind.apply(draft, rng)
    film(draft, rng)
    if base == "filmed":
        draft.seen, draft.truth = {}, None
        draft.after.append(lambda folder: file_kinds.write_videos(draft, folder))
    for phase in (DATA, FILES):
        for kind in chosen:
            if kind.phase == phase:
                kind.apply(draft, rng)
    return draft, base, all(kind.harmless for kind in chosen)


def small_images(draft):
    """Cameras of 64 x 48 pixels, whose videos are quickly written."""
    from dataclasses import replace

    for name, camera in draft.cameras.items():
        draft.cameras[name] = replace(
            camera, width=64, height=48, focal=(40.0, 40.0), principal=(31.5, 23.5)
        )


def run_case(names, seed, template=None, keep=None):
    """The outcome of one case, in this process.

    Args:
        names: of the kinds.
        seed: of the case.
        template: a folder with a finished project and its match, for kinds that spoil one.
        keep: a folder for the case's files; None = a temporary one.
    """
    work = Path(tempfile.mkdtemp(prefix="worldpose-fuzz-", dir=keep))
    try:
        if base_of(names) == "stored":
            return _stored_case(names, seed, template, work)
        return _match_case(names, seed, work)
    finally:
        if keep is None:
            shutil.rmtree(work, ignore_errors=True)


def _match_case(names, seed, work):
    try:
        draft, base, is_harmless = build(names, seed)
        write(draft, work / "match")
        _age(work / "match")
    except Exception as error:  # some kinds take away what others change
        return {"class": "not built", "message": f"{type(error).__name__}: {error}"}
    until = "ingest" if base == "filmed" else None
    try:
        store, match, record, failures = run_match(work / "match", work / "project", until)
    except Exception as error:
        kind, message = failure_class(error)
        answer = {"class": kind, "message": message}
        if kind == REFUSED and list((work / "project").glob("runs/*/*.json")):
            answer = {"class": "half-written", "message": message}
    else:
        answer = judge(draft, store, match, record, failures)
        if until and answer["class"] == UNJUDGED:
            answer["class"] = RIGHT
        left = leftovers(work / "project")
        if left and answer["class"] not in DEFECTS:
            answer |= {"class": "half-written", "message": ", ".join(left[:3])}
    return answer | {"harmless": is_harmless, "base": base}


def _age(folder):
    """Date a match folder's files a minute back: registration waits for those that just changed."""
    for path in folder.rglob("*"):
        before = path.lstat().st_mtime - 60.0
        os.utime(path, (before, before), follow_symlinks=False)


def _stored_case(names, seed, template, work):
    rng = np.random.default_rng([seed, zlib.crc32("+".join(names).encode())])
    project = Project(template, work)
    for name in names:
        KINDS[name].apply(project, rng)
    answer = {"class": RIGHT, "message": "", "harmless": False, "base": "stored"}
    for command, error in use_store(project) if _has_group(names, "store") else ():
        kind, message = failure_class(error)
        if answer["class"] not in DEFECTS:
            answer |= {"class": kind, "message": f"{command}: {message}"}
    if project.asked:
        try:
            answers = ask_all(project)
        except Exception as error:
            kind, message = failure_class(error)
            return answer | {"class": kind, "message": f"pages: {message}"}
        for method, path, status, text in answers:
            said = f"{method} {path}: {status} {text}"
            if status >= 500 and answer["class"] not in DEFECTS and not _names_store(names, text):
                answer |= {"class": "traceback", "message": said}
            elif status >= 400 and answer["class"] == RIGHT:
                answer |= {"class": REFUSED, "message": said}
    return answer


def _has_group(names, group):
    return any(KINDS[name].group == group for name in names)


def _names_store(names, text):
    """Return whether the case damaged the store and the page reports an error."""
    return _has_group(names, "store") and '"error"' in text


def prepare(template):
    """Load and compile all that cases use into this process, and make a project to spoil."""
    rng = np.random.default_rng(5)
    for is_clicked in (False, True):
        draft = new_draft(rng, is_clicked)
        film(draft, rng)
        folder = template / f"warm-{is_clicked}"
        write(draft, folder / "match")
        run_match(folder / "match", folder / "project")
    shutil.copytree(template / "warm-True" / "match", template / "match")
    shutil.copytree(template / "warm-True" / "project", template / "project")
    for file in (template / "project" / "matches").glob("*.json"):
        service_kinds._move(file, str(template / "warm-True" / "match"), str(template / "match"))
    from flows.web.access import access_for
    from flows.web.app import create_app

    access = access_for("127.0.0.1", token=service_kinds.TOKEN, names=(), secure=False)
    app = create_app(str(template / "project"), access)
    ROUTES[:] = routes(app)
