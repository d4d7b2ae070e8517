"""Matches known to a project: registering folders, opening what is registered."""

from __future__ import annotations

from pathlib import Path

from data_contracts.match import MatchSpec, Registration, SourceFile
from flows.corrections import corrected_match
from flows.stage import Match
from worldpose.body_fitting import read_monocular
from worldpose.errors import CorruptionError, InputError
from worldpose.ingest import (
    MatchFolder,
    read_match,
    read_unit,
    register_match,
    require_calibrated,
)
from worldpose.ingest.footage import require_footage
from worldpose.ingest.stills import read_still
from worldpose.store import Store


def register(store: Store, folder: Path, *, unfinished: bool = False) -> tuple[Match, bool]:
    """Validate a match folder and make it known; tells whether it was new or changed.

    The same content under another name is the same match. A known match whose videos, detections
    or pitch changed is another match and needs another id.

    Args:
        store: the project.
        folder: the match folder.
        unfinished: take it without knowing all of its cameras; people click them on the pages.

    Raises:
        InputError: the folder is not a valid match, or its id or content is taken.
    """
    match_folder = read_match(folder)
    match_id = match_folder.spec.match_id
    previous = store.registration(match_id)
    registration = register_match(match_folder, previous)
    match = corrected_match(store, match_folder, registration)
    if not unfinished:
        require_calibrated(match.folder)
    if previous is not None:
        if previous.identity != registration.identity:
            raise InputError(
                f"{folder}: match.yaml: match_id",
                expected=f"the videos, detections and pitch that {match_id} was registered with",
                found=_changes(previous.files, registration.files),
                todo="Restore the files, or give the changed match an id of its own.",
            )
        if previous == registration:
            return match, False
    _refuse_duplicate(store, registration)
    _read_new_files(match_folder, registration, previous)
    store.register(registration)
    return match, True


def open_match(store: Store, match_id: str) -> Match:
    """A registered match, with its folder read anew: annotations may have changed since.

    Raises:
        InputError: no such match, or its folder is not as it must be.
    """
    return register(store, Path(find_registration(store, match_id).folder))[0]


def open_for_review(store: Store, match_id: str) -> Match:
    """A registered match as `open_match` gives it, whether or not all its cameras are known."""
    folder = Path(find_registration(store, match_id).folder)
    return register(store, folder, unfinished=True)[0]


def find_registration(store: Store, name: str) -> Registration:
    """What the project knows of the match that a person means by a folder or an id.

    Nothing is read from the match folder but its id, and nothing is written: results stay
    readable when the folder has moved or has been edited.

    Raises:
        InputError: no such match.
    """
    folder = Path(name)
    match_id = read_match(folder).spec.match_id if (folder / "match.yaml").is_file() else name
    known = store.matches()
    registration = store.registration(match_id) if match_id in known else None
    if registration is None:
        raise InputError(
            f"match {name}",
            expected=f"a match folder or one of {', '.join(known) or '(none registered)'}",
            found=repr(name),
            todo="Register it: worldpose ingest FOLDER.",
        )
    return registration


def find_match(store: Store, name: str) -> Match:
    """The match that a person means by a folder or an id; a folder is registered first."""
    folder = Path(name)
    if (folder / "match.yaml").is_file() or (folder.is_dir() and name not in store.matches()):
        return register(store, folder)[0]
    return open_match(store, name)


def _refuse_duplicate(store: Store, registration: Registration) -> None:
    """Refuse a second folder of known content; a folder that moved is no second one."""
    for match_id in store.matches():
        try:
            known = store.registration(match_id)
        except CorruptionError:
            continue  # `status` and `verify` tell; another match can be registered all the same
        if known is None or known.identity != registration.identity:
            continue
        renamed = known.spec.match_id != registration.spec.match_id
        copied = known.folder != registration.folder and _is_there(Path(known.folder))
        if renamed or copied:
            raise InputError(
                f"{registration.folder}: match.yaml: match_id",
                expected="a match that is not registered yet",
                found=f"the content of {known.spec.match_id}, registered from {known.folder}",
                todo=f"The same content is one match: use {known.spec.match_id}.",
            )


def _is_there(folder: Path) -> bool:
    """Does the folder exist; one that does not answer may."""
    try:
        folder.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True


def _read_new_files(
    match: MatchFolder, registration: Registration, previous: Registration | None
) -> None:
    """Refuse broken 2D poses, videos and stills now, not in the middle of a run.

    All are read again where match.yaml says something else of them: they may not bear it out.
    """
    known: set[str] = set()
    if previous is not None and _of_footage(previous.spec) == _of_footage(match.spec):
        known = {source.sha256 for source in previous.files}

    def is_new(path: Path) -> bool:
        return registration.digest_of(path.relative_to(match.folder).as_posix()) not in known

    for unit, path in match.detections.items():
        if is_new(path):
            read_unit(match, unit)
    for unit, path in match.videos.items():
        if unit not in match.detections and (path.is_dir() or is_new(path)):
            require_footage(match.spec, unit, path)
    for path in filter(is_new, match.estimates.values()):
        read_monocular(path)
    for name, path in match.stills.items():
        camera = match.spec.camera(name)
        if is_new(path):
            read_still(path, (camera.width, camera.height))


def _of_footage(spec: MatchSpec) -> MatchSpec:
    """What match.yaml says of cameras and clips: who is who has no say in what files must be."""
    clips = tuple(clip.model_copy(update={"people": {}}) for clip in spec.clips)
    return spec.model_copy(update={"clips": clips, "roster": ()})


def _changes(before: tuple[SourceFile, ...], after: tuple[SourceFile, ...]) -> str:
    old = {source.path: source.sha256 for source in before}
    new = {source.path: source.sha256 for source in after}
    changed = sorted(path for path in old | new if old.get(path) != new.get(path))
    return f"changes in {', '.join(changed[:3])}" + (" and more" if len(changed) > 3 else "")
