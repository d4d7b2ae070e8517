"""Registration of match folders in a project, and access to registered matches."""

from __future__ import annotations

from collections.abc import Container
from concurrent.futures import ThreadPoolExecutor
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from data_contracts.match import MatchSpec, Registration
from flows.layers import pitch_in_words, pitch_of_run, read_layers
from flows.review.corrections import corrected_match
from flows.stage import Match
from worldpose.errors import CorruptionError, InputError
from worldpose.formats.detection_files import read_boxes
from worldpose.ingest.footage import read_still, read_unit, require_footage
from worldpose.ingest.match_folder import MatchFolder, read_match, read_spec, require_calibrated
from worldpose.ingest.registration import READERS, identifying_files, register_match
from worldpose.ingest.validation import reachable
from worldpose.review.journal import read_journal
from worldpose.store.paths import is_name
from worldpose.store.runs import may_be_running
from worldpose.store.store import Run, Store

if TYPE_CHECKING:
    from worldpose.video.pictures import FrameIndex


def register(
    store: Store,
    folder: Path,
    *,
    unfinished: bool = False,
    replaces: str | None = None,
    known_as: str | None = None,
) -> tuple[Match, bool]:
    """Validate and register a match folder; return whether it was new or changed.

    The same content under another name is the same match. A known match with changed videos,
    detections or pitch is another match and needs another id, unless it is the next version of the
    folder that it `replaces`: then runs, corrections and names stay. Before its first run it stays
    the same match, if only its pitch changed or it has no corrections. `unfinished` accepts it
    without all cameras known; people click them on the pages. `known_as` is the id that the folder
    must have.
    """
    spec = read_spec(folder)
    match_id = spec.match_id
    if known_as not in (None, match_id):
        raise InputError(
            f"{folder}: match.yaml: match_id",
            expected=f"{known_as}, which is registered with this folder",
            found=match_id,
            todo=f"Put the files of {known_as} back there, or register their new folder: worldpose "
            "ingest FOLDER.",
        )
    previous = store.registration(match_id)
    with reachable(folder):
        at_home = previous is not None and previous.folder == str(folder.resolve())
    known = [file.path for file in previous.files] if previous is not None and at_home else ()
    match_folder = read_match(folder, known, *pitch_in_words(store, folder, spec))
    is_next = previous is not None and previous.folder == replaces
    if replaces is not None and not is_next and not at_home:
        raise InputError(
            str(folder),
            expected=f"the next version of {match_id} after that in {replaces}",
            found="another version of it, registered meanwhile",
            todo="Remove this one, and add its files again on the page of the match.",
        )
    registration = (
        register_next(match_folder, previous)
        if is_next and previous is not None
        else register_match(match_folder, previous)
    )
    match = corrected_match(store, match_folder, registration)
    if not unfinished:
        require_calibrated(match.folder)
    if previous is not None:
        if previous.identity != registration.identity and not is_next:
            changed = _changed_files(match_folder, previous, registration)
            is_pitch = {*changed} <= {"pitch.json", spec.pitch, previous.spec.pitch}
            is_free = at_home and (is_pitch or not match.journal.entries)
            if not is_free or runs_of_pitch(store, folder):
                raise InputError(
                    f"{folder}: match.yaml: match_id",
                    f"the videos, detections and pitch that {match_id} was registered with",
                    f"changes in {', '.join(changed[:3])}" + " and more" * (len(changed) > 3),
                    "Restore the files, or give the changed match a new id.",
                )
        if previous == registration:
            return match, False
    _refuse_duplicate(store, registration, is_next=is_next)
    _read_new_files(match_folder, registration, previous)
    store.register(registration)
    return match, True


def runs_of_pitch(store: Store, folder: Path) -> list[str]:
    """Return MATCH/NUMBER of the runs of a folder's match that have ended or may be active."""
    if not (folder / "match.yaml").exists():
        return []
    match_id = read_spec(folder).match_id
    active = [run.run_id for run in store.unfinished_runs(match_id) if may_be_running(run)]
    return [f"{match_id}/{run_id}" for run_id in (*store.runs(match_id), *active)]


def register_next(folder: MatchFolder, before: Registration) -> Registration:
    """Return the registration of the next version of a match folder.

    Files that were linked or copied with their times keep their digests.
    """
    at_home = before.model_copy(update={"folder": str(folder.folder.resolve())})
    return register_match(folder, at_home)


def open_match(store: Store, match_id: str, *, unfinished: bool = False) -> Match:
    """Open a registered match and read its folder again: annotations may have changed since.

    `unfinished` accepts it without all cameras known.
    """
    known = find_registration(store, match_id)
    match_id, folder = known.spec.match_id, Path(known.folder)
    if not _is_there(folder):
        raise InputError(
            f"match {match_id}",
            expected=f"its folder, registered as {folder}",
            found="nothing there",
            todo="Mount its disk. If it was moved, or restored elsewhere, register it there, and "
            "its results stay: worldpose ingest FOLDER.",
        )
    return register(store, folder, unfinished=unfinished, known_as=match_id)[0]


def open_for_review(store: Store, match_id: str) -> Match:
    """Open a registered match like `open_match`, even if cameras are missing."""
    return open_match(store, match_id, unfinished=True)


def open_stored(store: Store, name: str) -> Match:
    """Open a registered match, given by folder or id, to show its results.

    If its folder is away, invalid or another match's now, the match is as the project knows it:
    without images and clicks. InputError if there is no such match.
    """
    registration = find_registration(store, name)
    match_id = registration.spec.match_id
    try:
        return open_for_review(store, match_id)
    except (InputError, OSError):
        spec, pitch = registration.spec, None
        if store.runs(match_id):
            pitch = pitch_of_run(Run(store, store.run(match_id)), lambda: None)
        paths = [Path(registration.folder, file.path) for file in registration.files]
        given = {path.stem: path for path in paths if path.parent.name == "detections"}
        folder = MatchFolder(Path(registration.folder), spec, {}, given, pitch, {}, {}, {}, {})
        journal, layers = read_journal(store, match_id), read_layers(store, spec)
        return Match(folder, registration, journal, layers=layers)


def find_registration(store: Store, name: str) -> Registration:
    """Return the registration of a match given by folder or id.

    Only the id is read from the match folder, and nothing is written: results stay readable when
    the folder has moved or has been edited.
    """
    folder = Path(name)
    match_id = read_spec(folder).match_id if (folder / "match.yaml").is_file() else name
    registration = store.registration(match_id) if is_name(match_id) else None
    if registration is None:
        known = store.matches()
        close = get_close_matches(match_id, known, n=1)
        meant = f"Did you mean {close[0]!r}? If not, register" if close else "Register"
        raise InputError(
            f"match {name}",
            expected=f"a match folder or one of {', '.join(known) or '(none registered)'}",
            found=repr(name),
            todo=f"{meant} the match: worldpose ingest FOLDER.",
        )
    return registration


def find_match(store: Store, name: str, *, unfinished: bool = False) -> Match:
    """Open a match given by folder or id as `open_match`; a folder is registered first."""
    folder = Path(name)
    if (folder / "match.yaml").is_file() or (folder.is_dir() and name not in store.matches()):
        return register(store, folder, unfinished=unfinished)[0]
    return open_match(store, name, unfinished=unfinished)


def _refuse_duplicate(store: Store, registration: Registration, *, is_next: bool) -> None:
    """Refuse a second folder of known content; a moved folder does not count as a second one."""
    own = {registration.spec.match_id} if is_next else set()
    for match_id in set(store.matches()) - own:
        try:
            known = store.registration(match_id)
        except CorruptionError:
            continue  # `status` and `verify` report it; other matches can be registered
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
    """Return whether the folder exists; one that does not answer counts as existing."""
    try:
        folder.stat()
    except OSError as error:
        return not isinstance(error, FileNotFoundError | NotADirectoryError)
    return True


def _read_new_files(
    match: MatchFolder, registration: Registration, previous: Registration | None
) -> None:
    """Refuse broken 2D poses, videos and stills now, not in the middle of a run.

    All files are read again if match.yaml changed: they may not agree with it.
    """
    known: set[str] = set()
    if previous is not None and _of_footage(previous.spec) == _of_footage(match.spec):
        known = {source.sha256 for source in previous.files}

    def is_new(path: Path) -> bool:
        return registration.digest_of(path.relative_to(match.folder).as_posix()) not in known

    with ThreadPoolExecutor(READERS) as threads:
        new = [unit for unit, path in match.detections.items() if is_new(path)]
        for _ in threads.map(lambda unit: read_unit(match, unit), new):
            pass  # an error is raised here, that of the first file
    boxes = {unit for unit, path in match.boxes.items() if is_new(path)}
    videos = {unit for unit, path in match.videos.items() if is_new(path)}
    for unit, index in _read_videos(match, videos | boxes).items():
        if unit in match.boxes:
            read_boxes(match.boxes[unit], index.size, len(index))
    for unit, path in match.camera_data.items():
        if is_new(path):
            from worldpose.ingest.camera_data import read_given_camera  # late: as below

            read_given_camera(match, unit, path)
    for path in filter(is_new, match.estimates.values()):
        from worldpose.body_fitting.monocular import (
            read_monocular,  # late: few matches have such files
        )

        read_monocular(path)
    for name, path in match.stills.items():
        camera = match.spec.camera(name)
        if is_new(path):
            read_still(path, (camera.width, camera.height))


def _read_videos(match: MatchFolder, new: Container[str]) -> dict[str, FrameIndex]:
    """Return the indices of videos that are not broken, of those that are new, by unit.

    It refuses videos that contradict match.yaml, and broken ones unless two cameras remain. Stage
    `ingest` leaves out the static cameras of broken videos.
    """
    from worldpose.video.folder import index_video  # late: few matches have new videos

    static = {camera.id for camera in match.spec.static_cameras}
    broken: dict[str, InputError] = {}
    indices: dict[str, FrameIndex] = {}
    unseen: dict[str, list[InputError]] = {}
    for unit, path in match.videos.items():
        whole = unit in match.calibrated_views
        unused = unit in match.detections and not whole
        if (unused and unit not in match.boxes) or not (path.is_dir() or unit in new):
            continue
        try:
            index = indices[unit] = index_video(path)
        except InputError as error:
            if unit not in static:
                raise
            broken[unit] = error
            continue
        if unused:
            continue
        for clip, refusal in require_footage(match.spec, unit, path, index, whole=whole).items():
            unseen.setdefault(clip, []).append(refusal)
    for errors in unseen.values():
        if len(errors) + len(broken) >= len(static):
            raise errors[0]
    if broken and len(static) - len(broken) < 2:
        raise next(iter(broken.values()))
    return indices


def _of_footage(spec: MatchSpec) -> MatchSpec:
    """Return match.yaml's camera and clip entries: names do not affect file checks."""
    clips = tuple(clip.model_copy(update={"people": {}}) for clip in spec.clips)
    return spec.model_copy(update={"clips": clips, "roster": (), "venue": None})


def _changed_files(match: MatchFolder, *sides: Registration) -> list[str]:
    """Return the videos, detections and pitch that differ between two registrations."""
    old, new = ({file.path: file.sha256 for file in side.files} for side in sides)
    own = identifying_files(match)
    own |= {path for path in old.keys() - new.keys() if not path.startswith("annotations/")}
    return sorted(path for path in own if old.get(path) != new.get(path))
