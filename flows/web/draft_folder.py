"""Match folder of a draft: what it takes over, how it is built, and what a run then computes.

A page never changes a registered match folder, which a run may be reading. It makes another folder
with the same id, that replaces the registered one; runs, corrections and names are of the id, and
stay.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

import yaml
from pydantic import JsonValue

from data_contracts.match import MatchSpec
from flows.layers import pitch_in_words, read_layers
from flows.method import METHOD
from flows.registering import register_next
from flows.review.corrections import corrected_match
from flows.run_record import expected_work, latest_run
from flows.run_status import plan_as_latest
from flows.service.inbox import SUMS
from flows.settings import resolve
from flows.web.draft_problems import (
    GIVEN,
    Index,
    Problem,
    describe,
    footage_problems,
    is_footage,
    take_given,
)
from worldpose.errors import InputError
from worldpose.formats.files import read_yaml
from worldpose.ingest.footage import uncovered_clips
from worldpose.ingest.match_folder import MatchFolder, read_match, read_spec
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.ingest.registration import register_match
from worldpose.ingest.validation import reachable
from worldpose.store.store import Store

LINKED_BYTES: Final = 1 << 20
"""Size from which a version of a match links a file in place of a copy [byte]."""
SPARE_BYTES: Final = 1 << 30
"""Disk space that a new file leaves free: results need some [byte]."""


def take_over(
    origin: Path, draft: Path, instead: dict[str, JsonValue]
) -> tuple[dict[str, JsonValue], dict[str, int]]:
    """Link or copy the files of a match folder into a draft; the folder stays as it is.

    Folders of images go to the draft's `match`, all other files to its `own`. Return match.yaml, or
    `instead` if that cannot be read, and the sizes of the files that a person can remove, by path
    [byte].
    """
    content, own = instead, draft / "own"
    with suppress(InputError):
        found = read_yaml(origin / "match.yaml")
        content = found if isinstance(found, dict) else instead
    copy_version(origin, own)
    (own / "match.yaml").unlink(missing_ok=True)
    for each in (own / "videos").glob("*/"):
        each.rename(draft / "match" / "videos" / each.name)
    paths = sorted(each for each in own.rglob("*") if each.is_file())
    sizes = {each.relative_to(own).as_posix(): each.stat().st_size for each in paths}
    filmed = ("videos/", "stills/", "broadcast/")
    sizes = {
        name: size for name, size in sizes.items() if is_footage(name) == name.startswith(filmed)
    }
    sizes = {name: size for name, size in sizes.items() if not name.startswith("reference/")}
    cameras = content.get("cameras")
    for camera in cameras if isinstance(cameras, list) else ():
        if isinstance(camera, dict) and (usual := f"videos/{camera.get('id')}.mp4") in sizes:
            camera.setdefault("video", usual)
    return json.loads(json.dumps(content, default=str)), sizes


def copy_version(origin: Path, target: Path) -> None:
    """Link large files of a match folder into another one; copy all that cannot be linked.

    InputError if the disk is too small for what has to be copied.
    """
    copied: list[tuple[Path, str]] = []

    def link(source: str, name: str) -> None:
        path = Path(source).resolve()
        with reachable(path):  # a link in a match folder can lead nowhere
            size = Path(source).stat().st_size
        with suppress(OSError):
            if size >= LINKED_BYTES:
                os.link(path, name)
                return
        copied.append((path, name))

    left = shutil.ignore_patterns(".*", SUMS)
    shutil.copytree(origin, target, copy_function=link, ignore=left, dirs_exist_ok=True)
    if (size := sum(path.stat().st_size for path, _ in copied)) >= LINKED_BYTES:
        require_space(target, origin.name, size)
    for path, name in copied:
        shutil.copy2(path, name)


def require_space(folder: Path, title: str, size: int) -> None:
    """Refuse bytes that would not leave `SPARE_BYTES` of the folder's disk."""
    needed, free = size + SPARE_BYTES, shutil.disk_usage(folder).free
    if needed > free:
        wanted, there = f"{needed / 1e9:.1f} GB of free disk space", f"{free / 1e9:.1f} GB"
        raise InputError(title, wanted, f"{there} at the inbox", "Free some, or ask the operator.")


def build(
    store: Store,
    content: Mapping[str, JsonValue],
    draft: Path,
    indexes: Mapping[str, Index | None],
    match_id: str | None = None,
) -> tuple[list[Problem], list[str]]:
    """Make the match folder again around its footage, with what all other files of a draft say.

    Matches of the store are not made again, but for the next version of `match_id`. In the folder
    of the draft, `match` is the match folder with its footage, `own` has files of a match folder,
    and `given` those of other tools. `indexes` are frames of the videos and sizes of the stills, by
    path in the match folder. Return the errors that ingest finds, and sentences about what was
    taken from other tools' files.
    """
    folder, given, notes = draft / "match", draft / GIVEN, list[str]()
    own = draft / "own"
    for each in sorted(folder.rglob("*"), reverse=True):
        name = each.relative_to(folder)
        is_uploaded = name.as_posix() in indexes and not (own / name).exists()
        is_image = name.parts[0] == "videos" and len(name.parts) > 2
        if each.is_file() and not is_uploaded and not is_image:
            each.unlink()
    text = yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)
    (folder / "match.yaml").write_text(text, encoding="utf-8")
    try:
        if own.is_dir():
            copy_version(own, folder)
        taken = take_given(store, given, folder, indexes) if given.is_dir() else []
        # No paths of this machine, no options of commands.
        notes = [re.sub(r"; --\w+ states another", "", it.replace(f"{given}/", "")) for it in taken]
        match = read_match(folder, (), *pitch_in_words(store, folder, read_spec(folder)))
        if match_id is None or taken:  # else 2D poses of hours would be read at each change
            notes += uncovered_clips(match)
        notes += _doubt_detector(store, match)
    except InputError as error:
        return [describe(error, folder, given)], notes
    owners = {*(each.id for each in match.spec.cameras), *match.spec.broadcast_views}
    for each in sorted(folder.glob("reference/cameras/*.npz")):
        if each.stem not in owners:
            each.unlink()
            notes.append(f"{each.relative_to(folder)} is left out: there is no such camera")
    problems = list(footage_problems(match, indexes, is_next=match_id is not None))
    if not problems and match_id is not None:
        try:
            problem, told = foresee(store, match)
        except InputError as error:  # a setting names a missing file
            return [describe(error, folder)], notes
        return problem, [*notes, *told]
    if not problems and (same := registered_as(store, match)):
        said = (
            f"These videos are the match {same}: open it in the list of matches, and discard this."
        )
        problems.append({"place": "", "message": said})
    return problems, notes


def _doubt_detector(store: Store, match: MatchFolder) -> list[str]:
    """Return a warning if the bundled nets, made for a pitch, would detect the people of a lab."""
    lacking = match.videos.keys() - match.detections.keys() - match.boxes.keys()
    if match.spec.pitch != NO_PITCH or not lacking:
        return []
    if "detection.detector" in resolve(read_layers(store, match.spec)).differences():
        return []
    return [
        f"warning: no 2D poses of {', '.join(sorted(lacking))} are given, so the run detects "
        "people in the videos. The bundled nets know people of 28 to 160 px, and miss taller ones. "
        "Add 2D poses of another tool, or state detection.detector and detection.pose in the "
        "settings."
    ]


def registered_as(store: Store, match: MatchFolder) -> str | None:
    """Return the registered match that has the content of a match folder; None if it is new."""
    files = {*match.videos.values(), *match.detections.values()}
    sizes = {str(file.relative_to(match.folder)): file.stat().st_size for file in files}
    for name in store.matches():
        if (known := store.registration(name)) is not None:
            is_like = sizes.items() <= {file.path: file.size for file in known.files}.items()
            if is_like and register_match(match, None).identity == known.identity:
                return name
    return None


def _is_sound(folder: Path) -> bool:
    with suppress(InputError, OSError):
        read_match(folder, whose=None)
        return True
    return False


def _with_usual_videos(spec: MatchSpec) -> MatchSpec:
    """Return match.yaml with the videos that a camera has without naming them, as forms do."""
    cameras = (
        each.model_copy(update={"video": each.video or f"videos/{each.id}.mp4"})
        for each in spec.cameras
    )
    return spec.model_copy(update={"cameras": tuple(cameras)})


def foresee(store: Store, folder: MatchFolder) -> tuple[list[Problem], list[str]]:
    """Return what forbids the next version of a match, and sentences about what it recomputes."""
    match_id = folder.spec.match_id
    before = store.registration(match_id)
    assert before is not None  # the draft began with its folder
    now = register_next(folder, before)
    files = [
        {each.path: each.sha256 for each in it.files if each.path != "match.yaml"}
        for it in (before, now)
    ]
    said = [_with_usual_videos(it.spec) for it in (before, now)]
    if files[0] == files[1] and said[0] == said[1] and _is_sound(Path(before.folder)):
        return [{"place": "", "message": "nothing has changed yet: add files, or discard this"}], []
    latest, match = latest_run(store, match_id), corrected_match(store, folder, now)
    if match.folder.to_click:
        names = ", ".join(match.folder.to_click)
        return [], [f"Before the next run, {names} must be calibrated on the page of the match."]
    plan = plan_as_latest(store, match, latest, {})
    missing = [unit for unit in plan if not unit.published]
    begun = {each.name.partition("/")[0] for each in missing}
    first = next((stage.about for stage in METHOD if stage.name in begun), "")
    seconds = sum(expected_work(store, match, missing, latest).values())
    minutes = max(1, round(seconds / 60 / max(1, os.cpu_count() or 1)))
    kept = len(plan) - len(missing)
    told = f"The next run begins with: {first}. It computes {len(missing)} results in about "
    told += f"{minutes} min, and keeps {kept}."
    return [], [told if missing else "The next run has nothing to compute."]
