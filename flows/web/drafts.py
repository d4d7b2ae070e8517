"""Matches that people create on the pages: drafts beside the inbox, until they are finished.

A draft is a folder in `INBOX/.drafts`, whose dot keeps it out of every scan of the inbox. Files
grow in its `parts`, move to its folders when they are whole, and the match folder moves into the
inbox in one step. The state is on disk: a restart of the server loses none of it.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from data_contracts.match import MatchSpec
from data_contracts.operations import Priority
from flows.service.inbox import next_version, put_in
from flows.service.layout import served_state
from flows.web.draft_folder import build, require_space, take_over
from flows.web.draft_problems import (
    GIVEN,
    GIVEN_ENDINGS,
    MATCH_FILES,
    Draft,
    DraftFile,
    Index,
    Problem,
    calibrated_cameras,
    camera_sizes,
    choose_name,
    describe_broken,
    form_problems,
    is_footage,
    still_size,
)
from flows.web.video_folders import open_video
from worldpose.errors import InputError, WorldposeError
from worldpose.formats.files import whole_file
from worldpose.ingest.validation import reachable, validate_record
from worldpose.store.store import Store
from worldpose.video.files import VideoReader, index_frames
from worldpose.video.folder import SUFFIXES as IMAGE_SUFFIXES
from worldpose.video.names import VIDEO_SUFFIXES, is_video
from worldpose.video.pictures import FrameIndex

DRAFTS: Final = ".drafts"
"""Folder of all drafts in the inbox."""
MAX_FILES: Final = 200
"""Files of one draft."""
MAX_DRAFTS: Final = 200
HALF_MADE_SECONDS: Final = 86400.0
"""Age at which a draft that was not made, or not removed, to the end is removed [s]."""
PIECE_BYTES: Final = 1 << 24
"""Bytes that are copied from a named folder in one step."""

LOG: Final = logging.getLogger("worldpose.pages")


@dataclass
class Drafts:
    """The drafts of an inbox.

    People can pick videos from the folders; ids of the store's matches are taken.
    """

    inbox: Path
    folders: Sequence[Path]
    store: Store
    _lock: Lock = field(default_factory=Lock)
    _budget: Lock = field(default_factory=Lock)
    _locks: dict[str, Lock] = field(default_factory=dict)
    _jobs: dict[str, Future[Index | str]] = field(default_factory=dict)
    _checked: dict[str, tuple[Any, list[Problem], list[str]]] = field(default_factory=dict)
    """Problems and notes of a draft's match folder, with what they were found for."""
    _pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2))

    def all(self) -> list[Draft]:
        """Return all drafts, the newest first; one that was finished is removed."""
        found = []
        for folder in self._root.glob("*"):
            with suppress(WorldposeError, OSError, ValueError):  # damaged, or just removed
                if folder.name.startswith(".") or not (folder / "draft.json").exists():
                    if time.time() - folder.stat().st_mtime > HALF_MADE_SECONDS:  # killed
                        shutil.rmtree(folder, ignore_errors=True)
                    continue
                draft = self.read(folder.name)
                if draft.finished_as is not None and not (folder / "match").exists():
                    shutil.rmtree(folder, ignore_errors=True)  # killed after the match had moved
                    continue
                found.append(draft)
        return sorted(found, key=lambda draft: draft.created_at, reverse=True)

    def create(self, who: str, match_id: str | None = None, corrects: Path | None = None) -> Draft:
        """Create a draft: empty, or with the content of a match folder, which stays as it is.

        The draft is the next version of the registered match `match_id`, or begins with the folder
        of the refused arrival that it `corrects`. InputError if there are too many drafts, no disk
        space for a copy, or files are gone.
        """
        known = None if match_id is None else self.store.registration(match_id)
        origin = corrects or (None if known is None else Path(known.folder))
        if origin is not None:
            with reachable(origin):
                origin.stat()
        if len(self.all()) >= MAX_DRAFTS:
            raise InputError("drafts", f"at most {MAX_DRAFTS}", "more", "Finish or discard some.")
        content: dict[str, JsonValue] = {"contract": 1, "cameras": [], "clips": []}
        draft = Draft(
            id=secrets.token_hex(8),
            who=who,
            created_at=datetime.now(UTC),
            content=content,
            match_id=match_id,
            replaces=None if known is None else known.folder,
            corrects=None if corrects is None else str(corrects),
        )
        folder = self._folder(draft.id)
        for inner in ("match/videos", "parts"):
            (folder / inner).mkdir(parents=True)
        if origin is not None:
            try:
                if known is not None:
                    content = known.spec.model_dump(mode="json", exclude_defaults=True)
                content, kept = take_over(origin, folder, content)
            except BaseException:
                shutil.rmtree(folder)
                raise
            files = tuple(
                DraftFile(id=secrets.token_hex(6), name=name, title=name, size=size, is_kept=True)
                for name, size in kept.items()
            )
            draft = draft.model_copy(update={"content": content, "files": files})
        self._write(draft)
        return draft

    def read(self, draft_id: str) -> Draft:
        """Return a draft; InputError if there is no draft with this id, here and below."""
        try:
            content = (self._folder(draft_id) / "draft.json").read_bytes()
        except FileNotFoundError:
            raise InputError(
                "draft", "a match being created", "none: finished or discarded", "See the matches."
            ) from None
        return Draft.model_validate_json(content)

    def save(self, draft_id: str, content: dict[str, JsonValue], revision: int) -> bool:
        """Save the form of a draft; return False if another one was saved since `revision`."""
        with self._hold(draft_id):
            draft = self.read(draft_id)
            if draft.revision != revision:
                return False
            self._write(draft.model_copy(update={"content": content, "revision": revision + 1}))
            return True

    def discard(self, draft_id: str) -> None:
        """Remove a draft with all its files."""
        with self._hold(draft_id):
            folder = self._folder(self.read(draft_id).id)
            gone = folder.with_name(f".{folder.name}.discarded")
            folder.rename(gone)
            shutil.rmtree(gone, ignore_errors=True)

    def add(self, draft_id: str, file: DraftFile) -> DraftFile:
        """Begin a file, or return the same one that was begun before: its transfer continues.

        The id of the file and its name in the match folder are chosen here. InputError if it is no
        video, still or file of a match folder, is empty, the disk is too small for it, or the draft
        has too many files.
        """
        title = PurePosixPath(file.title.replace("\\", "/")).name
        title = title.lower() if title.lower() in MATCH_FILES else title
        is_given = title.lower().endswith(GIVEN_ENDINGS) and title.lower() != "match.yaml"
        if title not in MATCH_FILES and not is_footage(title) and not is_given:
            known = f"a video ({' '.join(VIDEO_SUFFIXES)}), a still ({' '.join(IMAGE_SUFFIXES)})"
            sought = f"{known}, or calibration, clicks or 2D poses ({' '.join(GIVEN_ENDINGS)})"
            raise InputError(title, sought, "another file", "Convert it with the tool it is from.")
        with self._hold(draft_id):
            draft = self.read(draft_id)
            for each in draft.files:
                if each == file.model_copy(update={"id": each.id, "name": each.name}):
                    return each
            if sum(not it.is_kept for it in draft.files) >= MAX_FILES or file.size == 0:
                raise InputError(
                    title, f"a file with content, one of at most {MAX_FILES}", "another", "Omit it."
                )
            name = choose_name(title, {each.name for each in draft.files})
            chosen = file.model_copy(update={"id": secrets.token_hex(6), "name": name})
            with self._budget:
                listed = [(it.id, other) for it in self.all() for other in it.files]
                underway = sum(other.size - self._count_received(at, other) for at, other in listed)
                require_space(self.inbox, title, file.size + underway)
                self._write(draft.model_copy(update={"files": (*draft.files, chosen)}))
            return chosen

    def remove(self, draft_id: str, file_id: str) -> None:
        """Remove a file from a draft."""
        with self._hold(draft_id):
            draft, file = self._find(draft_id, file_id)
            files = tuple(each for each in draft.files if each.id != file_id)
            self._write(draft.model_copy(update={"files": files}))
            for path in (self._part(draft_id, file), self._whole(draft_id, file)):
                path.unlink(missing_ok=True)  # of a kept one, this is a link or a copy

    def append(self, draft_id: str, file_id: str, offset: int, chunk: bytes) -> tuple[bool, int]:
        """Append a chunk that a browser sent; return whether it fitted, and the bytes now there.

        A chunk at another place than the end is not taken: the browser continues at the end.
        InputError if there is no such file, or the chunk is longer than its rest.
        """
        with self._hold(draft_id):
            _, file = self._find(draft_id, file_id)
            received = self._count_received(draft_id, file)
            if file.folder is not None or offset != received:
                return False, received
            if received + len(chunk) > file.size:
                raise InputError(
                    file.title, f"{file.size} bytes", "more", "Remove it, and choose it again."
                )
            self._write_piece(draft_id, file, chunk)
            return True, received + len(chunk)

    def frame(
        self, draft_id: str, file_id: str, number: int, fps: float, width: int
    ) -> NDArray[np.uint8]:
        """Return the image (height, width, 3) RGB at a frame of a camera's clock, `fps` a second.

        It is that of `FrameIndex.on_clock`, or the nearest one where the video has none, scaled to
        a width [px]. InputError if there is no such video or frame, or the image is damaged.
        """
        _, file = self._find(draft_id, file_id)
        index = self._index(draft_id, file) if self._whole(draft_id, file).exists() else None
        if not isinstance(index, FrameIndex) or not 0 <= number <= np.rint(index.times[-1] * fps):
            raise InputError(file.title, f"a video with frame {number}", "none", "Choose another.")
        picture = int(np.abs(index.times - number / fps).argmin())
        with VideoReader(self._whole(draft_id, file), index) as video:
            for _, image in video.readable(picture, picture + 1, width=min(width, index.size[0])):
                if image is not None:
                    return image
        raise InputError(file.title, f"frame {number}", "a damaged one", "Choose another frame.")

    def view(self, draft_id: str) -> dict[str, Any]:
        """Return a draft for the pages, with all that is wrong or missing."""
        with self._hold(draft_id):  # it writes match.yaml
            return self._view(self.read(draft_id))

    def _view(self, draft: Draft) -> dict[str, Any]:
        files = [self._describe_file(draft.id, file) for file in draft.files]
        wrong = form_problems(draft.content, files)
        problems, notes = (wrong, []) if wrong else self._folder_problems(draft)
        return {
            **draft.model_dump(include={"id", "who", "created_at", "revision", "content"}),
            "adds_to": draft.match_id,
            "files": files,
            "problems": problems,
            "notes": notes,
            "is_ready": not problems,
        }

    def finish(self, draft_id: str, priority: Priority, revision: int | None = None) -> str | None:
        """Move a draft's match folder into the inbox in one step; return its path there.

        Nothing is moved, and None returned, if another form was saved since `revision`. InputError
        if something is wrong or missing.
        """
        with self._hold(draft_id):
            draft = self.read(draft_id)
            if revision not in (None, draft.revision):
                return None
            if problems := self._view(draft)["problems"]:
                raise InputError(
                    "match", "nothing missing", problems[0]["message"], "Complete it, then finish."
                )
            match_id, state = str(draft.content["match_id"]), served_state(self.store.url)
            name = match_id if priority == "normal" else f"{priority}/{match_id}"
            if draft.match_id is not None:
                name = next_version(self.inbox, name)
            folder = self._folder(draft_id)
            self._write(draft.model_copy(update={"finished_as": name}))
            origin = draft.replaces, draft.corrects
            try:
                put_in(state, self.inbox, folder / "match", name, priority, *origin)
            except (OSError, InputError):
                self._write(draft)
                raise
            shutil.rmtree(folder, ignore_errors=True)
            return name

    def continue_copies(self) -> None:
        """Continue the copies that a restart of the server interrupted."""
        for draft in self.all():
            for file in draft.files:
                self._describe_file(draft.id, file)

    @property
    def _root(self) -> Path:
        return self.inbox / DRAFTS

    def _folder(self, draft_id: str) -> Path:
        if not re.fullmatch(r"[0-9a-f]{16}", draft_id):
            raise InputError("draft", "a match being created", "another text", "See the matches.")
        return self._root / draft_id

    def _part(self, draft_id: str, file: DraftFile) -> Path:
        return self._folder(draft_id) / "parts" / file.id

    def _whole(self, draft_id: str, file: DraftFile) -> Path:
        top = "match" if is_footage(file.name) else "" if file.name.startswith(GIVEN) else "own"
        top = "own" if file.is_kept else top
        return self._folder(draft_id) / top / file.name

    def _write(self, draft: Draft) -> None:
        with whole_file(self._folder(draft.id) / "draft.json") as file:
            file.write_text(draft.model_dump_json(indent=2) + "\n", encoding="utf-8")

    @contextmanager
    def _hold(self, draft_id: str) -> Iterator[None]:
        """Hold a draft: one change at a time."""
        self._folder(draft_id)
        with self._lock:
            lock = self._locks.setdefault(draft_id, Lock())
        with lock:
            yield

    def _find(self, draft_id: str, file_id: str) -> tuple[Draft, DraftFile]:
        draft = self.read(draft_id)
        for file in draft.files:
            if file.id == file_id:
                return draft, file
        raise InputError("file", "a file of this match", "one that was removed", "Choose it again.")

    def _count_received(self, draft_id: str, file: DraftFile) -> int:
        if self._whole(draft_id, file).exists():
            return file.size
        with suppress(FileNotFoundError):
            return self._part(draft_id, file).stat().st_size
        return 0

    def _write_piece(self, draft_id: str, file: DraftFile, piece: bytes) -> None:
        """Append bytes to a file that is on its way, all or none; move it when it is whole."""
        require_space(self.inbox, file.title, len(piece))
        part = self._part(draft_id, file)
        with part.open("ab", buffering=0) as opened:
            before = opened.seek(0, os.SEEK_END)
            try:
                rest = memoryview(piece)
                while rest:
                    rest = rest[opened.write(rest) :]
                os.fdatasync(opened.fileno())
            except OSError:  # the disk is full: what it took of the piece is removed
                opened.truncate(before)
                raise
            size = before + len(piece)
        if size == file.size:
            whole = self._whole(draft_id, file)
            whole.parent.mkdir(exist_ok=True)
            part.rename(whole)

    def _describe_file(self, draft_id: str, file: DraftFile) -> dict[str, Any]:
        """Return the state of a file; begin what is to be done with it in the background."""
        received = self._count_received(draft_id, file)
        content = {**file.model_dump(), "received": received, "problem": ""}
        if received < file.size:
            if file.folder is None:
                return {**content, "state": "uploading"}
            problem = str(self._work(self._copy, draft_id, file) or "")
            return {**content, "state": "broken" if problem else "copying", "problem": problem}
        if not is_footage(file.name):
            whole = self._whole(draft_id, file)
            calibrates = calibrated_cameras(whole, whole.stat().st_mtime_ns)
            sizes = camera_sizes(whole)
            return {**content, "state": "ready", "cameras": sizes, "calibrates": calibrates}
        index = self._index(draft_id, file)
        if index is None:
            return {**content, "state": "reading"}
        if isinstance(index, InputError):
            return {**content, "state": "broken", "problem": describe_broken(index)}
        size = index.size if isinstance(index, FrameIndex) else index
        shape: dict[str, Any] = dict(zip(("width", "height"), size, strict=True))
        if isinstance(index, FrameIndex):
            shape |= {"fps": index.fps, "frames": len(index), "seconds": float(index.times[-1])}
        return {**content, "state": "ready", **shape}

    def _work(
        self, job: Callable[[str, DraftFile], Index | str], draft_id: str, file: DraftFile
    ) -> Index | str | None:
        """Do a job with a file once in the background; return None until it has ended."""

        def work() -> Index | str:
            try:
                return job(draft_id, file)
            except Exception as error:  # a bug: the page shows it, and polling does not repeat it
                LOG.exception("%s of a match being created", file.title)
                return InputError(
                    file.title,
                    "a file that can be taken in",
                    type(error).__name__,
                    "The service's log has the details. Remove the file and add it again.",
                )

        key = f"{draft_id} {file.id} {job.__name__}"
        with self._lock:
            if key not in self._jobs:
                self._jobs[key] = self._pool.submit(work)
        return self._jobs[key].result() if self._jobs[key].done() else None

    def _index(self, draft_id: str, file: DraftFile) -> Index | None:
        """Return the index of a whole file; None until it is read."""
        found = self._work(self._read_index, draft_id, file)
        assert not isinstance(found, str)  # only copies have text
        return found

    def _read_index(self, draft_id: str, file: DraftFile) -> Index:
        path = self._whole(draft_id, file)
        try:
            return index_frames(path) if is_video(file.name) else still_size(path)
        except InputError as error:
            return error

    def _copy(self, draft_id: str, file: DraftFile) -> str:
        """Copy a video from a named folder, from where an earlier copy ended; return a problem."""
        assert file.folder is not None  # the caller asks for a copy only of such files
        try:
            with open_video(self.folders, file.folder, file.source) as source:
                while True:
                    status = os.fstat(source)
                    is_same = status.st_mtime_ns // 1_000_000 == file.modified_ms
                    if not is_same or status.st_size != file.size:
                        return "It changed while it was copied. Remove it, pick it again."
                    with self._hold(draft_id):
                        self._find(draft_id, file.id)
                        received = self._count_received(draft_id, file)
                        if received == file.size:
                            return ""
                        self._write_piece(draft_id, file, os.pread(source, PIECE_BYTES, received))
        except InputError as error:
            return str(error)
        except OSError as error:
            return error.strerror or str(error)

    def _folder_problems(self, draft: Draft) -> tuple[list[Problem], list[str]]:
        """Build the match folder; return the errors that ingest finds, and sentences about it."""
        spec = validate_record(MatchSpec, draft.content, "match.yaml")
        registered = map(self.store.registration, self.store.matches() if draft.corrects else ())
        if any(it is not None and it.folder == draft.corrects for it in registered):
            message = "it was taken in meanwhile: discard this, and open it in the list of matches"
            return [{"place": "", "message": message}], []
        places = (self.inbox / at / spec.match_id for at in (".", "urgent", "background"))
        is_taken = any(it.exists() and str(it.resolve()) != draft.corrects for it in places)
        is_taken = is_taken or spec.match_id in self.store.matches()
        if draft.match_id is None and is_taken:
            message = "expected an id of its own, found that of another match. Choose another one."
            return [{"place": "match_id", "message": message}], []
        if draft.match_id not in (None, spec.match_id):
            message = f"expected {draft.match_id}, found another one. Write the id of the match."
            return [{"place": "match_id", "message": message}], []
        known = None if draft.match_id is None else self.store.registration(draft.match_id)
        if known is not None and known.folder != draft.replaces:
            message = "another person added files meanwhile: discard this, and begin again"
            return [{"place": "", "message": message}], []
        key = (draft.revision, draft.files)
        if self._checked.get(draft.id, (None,))[0] != key:
            folder = self._folder(draft.id)
            footage = (it for it in draft.files if is_footage(it.name))
            indexes = {it.name: self._index(draft.id, it) for it in footage}
            found = build(self.store, draft.content, folder, indexes, draft.match_id)
            self._checked[draft.id] = (key, *found)
        return self._checked[draft.id][1:]
