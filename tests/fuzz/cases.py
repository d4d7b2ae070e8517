"""Cases: which kinds strike together, and one case from its beginning to its outcome."""

import os
import shutil
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from worldpose.video.files import write_video

from . import content_kinds  # noqa: F401 - it registers
from .judging import DEFECTS, REFUSED, RIGHT, UNJUDGED, failure_class, judge, leftovers, run_match
from .kinds import DATA, FILES, FILM, KINDS, one
from .scene import film, new_draft, write
from .stored_kinds import Project, ask_all, use_store

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
    rng, groups = np.random.default_rng([seed, number]), sorted(WEIGHTS)
    share = np.array([WEIGHTS[group] for group in groups], dtype=float)
    group = str(rng.choice(groups, p=share / share.sum()))
    of_group = sorted(name for name in KINDS if KINDS[name].group == group)
    order = np.random.default_rng([seed, groups.index(group)]).permutation(len(of_group))
    chosen = [of_group[order[number % len(of_group)]]]
    wanted = 1 if rng.random() < 0.5 else int(rng.integers(2, 5))
    for _ in range(40):
        pool = sorted(KINDS)
        if KINDS[chosen[0]].base != "stored" and rng.random() < 0.8:
            pool = [name for name in pool if KINDS[name].group in FURTHER]
        further = one(rng, pool)
        if len(chosen) < wanted and further not in chosen and base_of([*chosen, further]):
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
    allowed = {"stored": {"store", "request"}, "filmed": {"video", "ids"}}
    if len(bases) > 1 or any(groups - allowed.get(base, groups) for base in bases):
        return None
    return bases.pop() if bases else "any"


def generator(names, seed):
    return np.random.default_rng([seed, zlib.crc32("+".join(names).encode())])


def build(names, seed):
    """The draft of a case, spoilt; and the match that it is of."""
    rng, base = generator(names, seed), base_of(names)
    if base == "any":
        base = one(rng, ["clicked", "given"])
    draft = new_draft(rng, base == "clicked")
    if base == "filmed":
        small = {"width": 64, "height": 48, "focal": (40.0, 40.0), "principal": (31.5, 23.5)}
        draft.cameras = {name: replace(each, **small) for name, each in draft.cameras.items()}
    for phase in (FILM, DATA, FILES):
        if phase == DATA:
            film(draft, rng)
            if base == "filmed":
                draft.seen, draft.truth = {}, None
                draft.after.append(lambda folder: write_videos(draft, folder / "videos"))
        for kind in (KINDS[name] for name in names):
            if kind.phase == phase:
                kind.apply(draft, rng)
    return draft, base


def write_videos(draft, folder):
    """Small videos of a match of which nothing else is known."""
    folder.mkdir(exist_ok=True)
    for number, each in enumerate(draft.spec["cameras"]):
        greys = 20 + 10 * number + 3 * np.arange(draft.spec["clips"][0]["frame_count"])
        pictures = [np.full((each["height"], each["width"], 3), grey, np.uint8) for grey in greys]
        write_video(folder / f"{each['id']}.mp4", pictures, float(draft.spec["fps"]), quality=5)


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
        is_harmless = all(KINDS[name].harmless for name in names)
        if base_of(names) == "stored":
            return _stored_case(names, seed, template, work) | {"harmless": False}
        return _match_case(names, seed, work) | {"harmless": is_harmless}
    finally:
        if keep is None:
            shutil.rmtree(work, ignore_errors=True)


def _match_case(names, seed, work):
    try:
        draft, base = build(names, seed)
        write(draft, work / "match")
        for path in (work / "match").rglob("*"):  # registration waits for those that just changed
            before = path.lstat().st_mtime - 60.0
            os.utime(path, (before, before), follow_symlinks=False)
    except Exception as error:  # some kinds take away what others change
        return {"class": "not built", "message": f"{type(error).__name__}: {error}"}
    project, until = work / "project", "ingest" if base == "filmed" else None
    try:
        store, match, record, failures = run_match(work / "match", project, until)
    except Exception as error:
        kind, message = failure_class(error)
        answer, left = {"class": kind, "message": message}, list(project.glob("runs/*/*.json"))
    else:
        answer, left = judge(draft, store, match, record, failures), []
        if until and answer["class"] == UNJUDGED:
            answer["class"] = RIGHT
    left = [*map(str, left), *leftovers(project)]
    if left and answer["class"] not in DEFECTS:
        answer |= {"class": "half-written", "message": ", ".join(left[:3])}
    return answer


def _stored_case(names, seed, template, work):
    rng, project = generator(names, seed), Project(template, work)
    for name in names:
        KINDS[name].apply(project, rng)
    is_damaged = any(KINDS[name].group == "store" for name in names)
    classes = [(RIGHT, "")]
    for command, error in use_store(project) if is_damaged else ():
        kind, message = failure_class(error)
        classes.append((kind, f"{command}: {message}"))
    try:
        for asked, status, text in ask_all(project, rng):
            is_told = is_damaged and '"error"' in text
            kind = "traceback" if status >= 500 and not is_told else REFUSED
            if status >= 400:
                classes.append((kind, f"{asked}: {status} {text}"))
    except Exception as error:
        kind, message = failure_class(error)
        classes.append((kind, f"pages: {message}"))
    kind, message = next((each for each in classes if each[0] in DEFECTS), classes[-1])
    return {"class": kind, "message": message}


def prepare(template):
    """Load and compile all that cases use into this process, and make a project to spoil."""
    rng = np.random.default_rng(5)
    for is_clicked in (False, True):
        draft, place = new_draft(rng, is_clicked), template / f"warm-{is_clicked}"
        film(draft, rng)
        write(draft, place / "match")
        run_match(place / "match", place / "project")
    place.rename(template / "finished")
    return template / "finished"
