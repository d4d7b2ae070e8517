"""Downloads of pinned checkpoints into the user's cache.

Only `worldpose models pull` calls this. Every file is checked against its pinned SHA-256; a
checkpoint appears in the cache as a whole, when all of its files are right.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Final
from urllib.parse import quote, urlsplit

import httpx

from data_contracts.checkpoint import Checkpoint, CheckpointCatalog, CheckpointFile
from worldpose.detection.models import PULLED_FILES, PULLED_RECORD, read_pulled
from worldpose.errors import InputError, UsageError, WorldposeError
from worldpose.formats.files import read_yaml, whole_file
from worldpose.ingest.validation import validate_record

ANSWER_SECONDS: Final = 30.0
"""Timeout for a server's response, and for each part of it."""
CHUNK_BYTES: Final = 1 << 20
MAX_ARCHIVE_BYTES: Final = 1 << 33
"""Largest zip archive [byte]; only the size of the file in it is pinned."""
HUB: Final = re.compile(r"hf://([\w.-]+/[\w.-]+)@([0-9a-f]{40})/([\w./-]+)")
"""Address of a file on the Hugging Face hub: repository, whole commit id, path."""
SHIPPED: Final = Path(__file__).with_name("checkpoints.yaml")
"""The checkpoints that worldpose names."""
Progress = Callable[[str, int, int], None]
"""Called with the name of a file, and the bytes that are there and that it has."""


def read_catalog(file: Path | None) -> dict[str, Checkpoint]:
    """Return the shipped checkpoints and those of a user's file, by name."""
    found: dict[str, Checkpoint] = {}
    for each in (SHIPPED, file) if file is not None else (SHIPPED,):
        for checkpoint in validate_record(CheckpointCatalog, read_yaml(each), str(each)).models:
            if checkpoint.name in found:
                raise InputError(
                    f"{each}: models",
                    expected="names of their own",
                    found=f"{checkpoint.name!r} again",
                    todo="Give the checkpoint another name.",
                )
            found[checkpoint.name] = checkpoint
    return found


def pull(checkpoint: Checkpoint, folder: Path, progress: Progress) -> Path:
    """Download the missing files of a checkpoint, check them, and return its folder in the cache.

    What an interrupted pull has downloaded stays in a hidden folder, and the next pull resumes
    there. A file with another digest is removed. InputError if an address is not https, or a file
    has another digest or size; WorldposeError if the download failed, or another process pulls it.
    """
    target = folder / checkpoint.name
    if read_pulled(checkpoint.name, folder) == checkpoint and not find_damage(target, checkpoint):
        return target
    draft = folder / f".{checkpoint.name}.partial"
    files = draft / PULLED_FILES
    files.mkdir(parents=True, exist_ok=True)
    with (draft / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise WorldposeError(
                f"{checkpoint.name}: another process is pulling this checkpoint. Wait for it."
            ) from error
        for file in checkpoint.files:
            if _digest(files / file.name) != file.sha256:
                _fetch_file(checkpoint.name, file, files / file.name, draft, progress)
        with whole_file(draft / PULLED_RECORD) as record:
            record.write_text(checkpoint.model_dump_json(indent=2) + "\n", encoding="utf-8")
        (draft / "lock").unlink()
        if target.exists():
            shutil.rmtree(target)
        draft.rename(target)
    return target


def find_damage(folder: Path, checkpoint: Checkpoint) -> list[str]:
    """Return the names of missing files and of those with another digest than the pinned one."""
    return [
        file.name
        for file in checkpoint.files
        if _digest(folder / PULLED_FILES / file.name) != file.sha256
    ]


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; empty if there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fetch_file(
    name: str, file: CheckpointFile, path: Path, draft: Path, progress: Progress
) -> None:
    """Bring one file of a checkpoint to its path."""
    url = resolve_address(file.url)
    part = draft / f"{file.name}.part"
    most = MAX_ARCHIVE_BYTES if file.member else file.size
    try:
        _download(url, part, most, lambda done, total: progress(file.name, done, total))
    except (OSError, httpx.HTTPError, UsageError) as error:
        said = getattr(error, "strerror", None) or error
        raise WorldposeError(
            f"{name}: downloading {url} failed: {type(error).__name__}: {said}. Run the command "
            "again: it resumes where it stopped."
        ) from error
    if file.member is None:
        part.replace(path)
    else:
        _extract(name, file, part, path)
        part.unlink()
    found = _digest(path)
    if found != file.sha256:
        path.unlink()
        raise InputError(
            f"{name}: {file.name} of {file.url}",
            expected=f"SHA-256 {file.sha256}",
            found=found,
            todo="The file was removed. It is not the one that was pinned: do not use it, or "
            "correct the digest in your catalog.",
        )


def resolve_address(url: str) -> str:
    """Return the http address of a file; HF_ENDPOINT names another hub than huggingface.co.

    UsageError unless it is https, http of this machine, or hf: with a whole commit id.
    """
    found = HUB.fullmatch(url)
    if found is not None:
        hub = os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")
        repository, revision, path = found.groups()
        url = f"{hub}/{repository}/resolve/{revision}/{quote(path)}"
    _require_safe(url)
    return url


def _require_safe(url: str) -> None:
    """Raise UsageError unless an address is https, or http of this machine."""
    try:
        parts = urlsplit(url)
        host = parts.hostname
    except ValueError:
        parts, host = urlsplit(""), None
    is_local = parts.scheme == "http" and host in ("127.0.0.1", "localhost", "::1")
    if not host or not (parts.scheme == "https" or is_local):
        raise UsageError(
            "address of a checkpoint",
            expected="https://HOST/PATH, or hf://OWNER/REPOSITORY@COMMIT/FILE with a commit id of "
            "40 characters",
            found=repr(url),
            todo="Correct url in the catalog.",
        )


def _download(url: str, part: Path, most: int | None, progress: Callable[[int, int], None]) -> None:
    """Download into `part`, going on where it ends; redirects may lead to safe addresses alone."""
    there = part.stat().st_size if part.exists() else 0
    headers = {"User-Agent": "worldpose", "Accept-Encoding": "identity"}
    if there:
        headers["Range"] = f"bytes={there}-"
    hooks = {"request": [lambda request: _require_safe(str(request.url))]}
    client = httpx.Client(follow_redirects=True, timeout=ANSWER_SECONDS, event_hooks=hooks)
    with client, client.stream("GET", url, headers=headers) as answer:
        if answer.status_code == 416:
            return  # nothing lies behind the end: the file is there as a whole
        answer.raise_for_status()
        is_rest = answer.headers.get("Content-Range", "").startswith(f"bytes {there}-")
        if answer.status_code == 206 and not is_rest:
            raise OSError("the server sent another part of the file than was asked for")
        done = there if answer.status_code == 206 else 0
        total = done + int(answer.headers.get("Content-Length") or 0)
        with part.open("ab" if done else "wb") as file:
            for chunk in answer.iter_raw():
                done += len(chunk)
                if most is not None and done > most:
                    break
                file.write(chunk)
                progress(done, total)
    if most is not None and done > most:
        part.unlink()
        raise OSError(f"the file is longer than {most} bytes, which is its pinned or largest size")


def _extract(name: str, file: CheckpointFile, archive: Path, path: Path) -> None:
    """Write one file of a zip archive to `path`, at most as large as pinned."""
    assert file.member is not None
    most = file.size or MAX_ARCHIVE_BYTES
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [
                each
                for each in opened.namelist()
                if each == file.member or each.endswith(f"/{file.member}")
            ]
            if len(members) != 1:
                raise zipfile.BadZipFile(f"{len(members)} files {file.member}")
            with opened.open(members[0]) as source, path.open("wb") as out:
                left = most + 1
                while left and (chunk := source.read(min(CHUNK_BYTES, left))):
                    out.write(chunk)
                    left -= len(chunk)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        archive.unlink()
        path.unlink(missing_ok=True)
        raise InputError(
            f"{name}: {file.url}",
            expected=f"a zip archive with one {file.member}",
            found=str(error),
            todo="The archive was removed. Correct url or member in the catalog.",
        ) from error
