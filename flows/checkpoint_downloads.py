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
import ssl
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPException, HTTPMessage, HTTPResponse
from pathlib import Path
from typing import IO, Final
from urllib.error import HTTPError
from urllib.parse import quote, urlsplit

import certifi

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
Progress = Callable[[str, int, int], None]
"""Called with the name of a file, and the bytes that are there and that it has."""

_OPENMMLAB: Final = "https://download.openmmlab.com/mmpose/v1/projects/rtmposev1/onnx_sdk"
_YOLOX: Final = "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0"
_RTDETR: Final = "hf://PekingU/rtdetr_v2_r18vd@5650961749fa93567c0d46fc7f43ea4f9e914107"


def _onnx(name: str, task: str, kind: str, about: str, file: dict[str, object]) -> Checkpoint:
    """Return a checkpoint of one ONNX file under Apache-2.0."""
    return Checkpoint.model_validate(
        {
            "name": name,
            "about": about,
            "task": task,
            "kind": kind,
            "licence": "Apache-2.0",
            "files": ({"name": "model.onnx", **file},),
        }
    )


CATALOG: Final = {
    each.name: each
    for each in (
        _onnx(
            "yolox-nano",
            "detector",
            "onnx-yolox",
            "YOLOX-nano, COCO, 416 x 416: small and quick",
            {
                "url": f"{_YOLOX}/yolox_nano.onnx",
                "sha256": "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
                "size": 3_659_407,
            },
        ),
        _onnx(
            "yolox-tiny",
            "detector",
            "onnx-yolox",
            "YOLOX-tiny, COCO, 416 x 416",
            {
                "url": f"{_YOLOX}/yolox_tiny.onnx",
                "sha256": "427cc366d34e27ff7a03e2899b5e3671425c262ea2291f88bb942bc1cc70b0f7",
                "size": 20_219_662,
            },
        ),
        _onnx(
            "yolox-s",
            "detector",
            "onnx-yolox",
            "YOLOX-s, COCO, 640 x 640, of the OpenCV model zoo",
            {
                "url": "https://media.githubusercontent.com/media/opencv/opencv_zoo/"
                "966be4cb6eefc2a4f586ed0581bf4bbaa2533070/models/object_detection_yolox/"
                "object_detection_yolox_2022nov.onnx",
                "sha256": "c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063",
                "size": 35_858_002,
            },
        ),
        Checkpoint.model_validate(
            {
                "name": "rtdetr-v2-r18",
                "about": "RT-DETRv2 with a ResNet-18, COCO, 640 x 640, for transformers",
                "task": "detector",
                "kind": "transformers",
                "licence": "Apache-2.0",
                "files": (
                    {
                        "name": "model.safetensors",
                        "url": f"{_RTDETR}/model.safetensors",
                        "sha256": "d18309d0d7ea57048138885c4c6ecfcb"
                        "1e24506fc6153b94ad484f8ab62c7115",
                        "size": 80_904_640,
                    },
                    {
                        "name": "config.json",
                        "url": f"{_RTDETR}/config.json",
                        "sha256": "ed051ec77cb41c5d9d5e3af21a979b1e"
                        "890599dfd68434d7636ff82ded4c1527",
                    },
                    {
                        "name": "preprocessor_config.json",
                        "url": f"{_RTDETR}/preprocessor_config.json",
                        "sha256": "cd38cd59999e7a95d68e487fbe5132df"
                        "3d4e5c32a0836add57e6126ba0c4eaf1",
                    },
                ),
            }
        ),
        _onnx(
            "rtmpose-m",
            "pose",
            "onnx",
            "RTMPose-m, seven body data sets, 256 x 192",
            {
                "url": f"{_OPENMMLAB}/"
                "rtmpose-m_simcc-body7_pt-body7_420e-256x192-e48f03d0_20230504.zip",
                "member": "end2end.onnx",
                "sha256": "5c0a4bf67953e6d2ac43ce15e77dc9d5d354ae18430a47d2c5963a7bc5683e3c",
                "size": 54_330_655,
            },
        ),
        _onnx(
            "rtmpose-s",
            "pose",
            "onnx",
            "RTMPose-s, seven body data sets, 256 x 192",
            {
                "url": f"{_OPENMMLAB}/"
                "rtmpose-s_simcc-body7_pt-body7_420e-256x192-acd4a1ef_20230504.zip",
                "member": "end2end.onnx",
                "sha256": "9aeb635b83f86aea45cf45d85798f7eba1a162de8e0d721c44e54fe5eebaf47d",
            },
        ),
    )
}
"""The checkpoints that worldpose names, by name."""


def read_catalog(file: Path | None) -> dict[str, Checkpoint]:
    """Return the shipped checkpoints and those of a user's file, by name.

    Raises:
        InputError: the file is no catalog, or names a checkpoint twice or as a shipped one.
    """
    found = dict(CATALOG)
    if file is None:
        return found
    for each in validate_record(CheckpointCatalog, read_yaml(file), str(file)).models:
        if each.name in found:
            raise InputError(
                f"{file}: models",
                expected="names of their own",
                found=f"{each.name!r} again",
                todo="Give the checkpoint another name.",
            )
        found[each.name] = each
    return found


def pull(checkpoint: Checkpoint, folder: Path, progress: Progress) -> Path:
    """Download the missing files of a checkpoint, check them, and return its folder in the cache.

    What an interrupted pull has downloaded stays in a hidden folder, and the next pull resumes
    there. A file with another digest is removed.

    Raises:
        InputError: an address is not https, or a file has another digest or size.
        WorldposeError: the download failed, or another process pulls this checkpoint.
    """
    target = folder / checkpoint.name
    if read_pulled(checkpoint.name, folder) == checkpoint and not find_damage(target, checkpoint):
        return target
    draft = folder / f".{checkpoint.name}.partial"
    files = draft / PULLED_FILES
    files.mkdir(parents=True, exist_ok=True)
    with _only_process(draft, checkpoint.name):
        for file in checkpoint.files:
            _fetch_file(checkpoint.name, file, files / file.name, draft, progress)
        with whole_file(draft / PULLED_RECORD) as record:
            record.write_text(checkpoint.model_dump_json(indent=2) + "\n", encoding="utf-8")
        (draft / LOCK).unlink()
        if target.exists():
            shutil.rmtree(target)
        draft.rename(target)
    return target


LOCK: Final = "lock"


@contextmanager
def _only_process(draft: Path, name: str) -> Iterator[None]:
    with (draft / LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise WorldposeError(
                f"{name}: another process is pulling this checkpoint. Wait for it."
            ) from error
        yield


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
    """Bring one file of a checkpoint to its path, unless it is there."""
    if _digest(path) == file.sha256:
        return
    url = resolve_address(file.url)
    part = draft / f"{file.name}.part"
    most = MAX_ARCHIVE_BYTES if file.member else file.size
    try:
        if file.member is None:
            _refuse_other_file(name, file, url)
        _download(url, part, most, lambda done, total: progress(file.name, done, total))
        if file.member is not None:
            _extract(name, file, part, path)
            part.unlink()
        else:
            part.replace(path)
    except (OSError, HTTPException) as error:
        raise WorldposeError(
            f"{name}: downloading {url} failed: {type(error).__name__}: {error}. Run the command "
            "again: it resumes where it stopped."
        ) from error
    found = _digest(path)
    if found != file.sha256:
        path.unlink()
        raise _other_digest(name, file, found)


def _other_digest(name: str, file: CheckpointFile, found: str) -> InputError:
    return InputError(
        f"{name}: {file.name} of {file.url}",
        expected=f"SHA-256 {file.sha256}",
        found=found,
        todo="The file was removed. It is not the one that was pinned: do not use it, or correct "
        "the digest in your catalog.",
    )


def resolve_address(url: str) -> str:
    """Return the http address of a file; HF_ENDPOINT names another hub than huggingface.co.

    Raises:
        UsageError: the address is neither https, http of this machine, nor hf: with a whole commit
            id.
    """
    if url.startswith("hf:"):
        found = HUB.fullmatch(url)
        if found is None:
            raise _bad_address(url)
        hub = os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")
        repository, revision, path = found.groups()
        url = f"{hub}/{repository}/resolve/{revision}/{quote(path)}"
    if not _is_allowed(url):
        raise _bad_address(url)
    return url


def _is_allowed(url: str) -> bool:
    """Return whether an address is https, or http of this machine."""
    try:
        parts = urlsplit(url)
        host = parts.hostname
    except ValueError:
        return False
    local = parts.scheme == "http" and host in ("127.0.0.1", "localhost", "::1")
    return bool(host) and (parts.scheme == "https" or local)


def _bad_address(url: str) -> UsageError:
    return UsageError(
        "address of a checkpoint",
        expected="https://HOST/PATH, or hf://OWNER/REPOSITORY@COMMIT/FILE with a commit id of 40 "
        "characters",
        found=repr(url),
        todo="Correct url in the catalog.",
    )


class _SafeRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to addresses that are allowed, or none of them."""

    def __init__(self, *, follow: bool = True) -> None:
        self._follow = follow

    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: HTTPMessage,
        newurl: str,
    ) -> urllib.request.Request | None:
        """Return the next request; None makes the redirect an HTTPError."""
        if not self._follow or not _is_allowed(newurl):
            return None
        return super().redirect_request(req, fp, code, msg, headers, newurl)


@contextmanager
def _open(request: urllib.request.Request, *, follow: bool = True) -> Iterator[HTTPResponse]:
    request.add_header("User-Agent", "worldpose")
    certificates = ssl.create_default_context(cafile=certifi.where())
    opener = urllib.request.build_opener(
        _SafeRedirects(follow=follow), urllib.request.HTTPSHandler(context=certificates)
    )
    with opener.open(request, timeout=ANSWER_SECONDS) as answer:
        yield answer


def _refuse_other_file(name: str, file: CheckpointFile, url: str) -> None:
    """Raise InputError before the download if the hub names another digest for a large file."""
    if not file.url.startswith("hf:"):
        return
    try:
        with _open(urllib.request.Request(url, method="HEAD"), follow=False) as answer:
            linked = answer.headers.get("X-Linked-Etag")
    except HTTPError as error:
        if not 300 <= error.code < 400:
            raise
        linked = error.headers.get("X-Linked-Etag")
        error.close()
    linked = (linked or "").removeprefix("W/").strip('"')
    if re.fullmatch(r"[0-9a-f]{64}", linked) and linked != file.sha256:
        raise _other_digest(name, file, linked)


@dataclass(frozen=True)
class _Range:
    """The part of a file that a response holds: its first byte, and the file's size if known."""

    start: int
    total: int


def _download(url: str, part: Path, most: int | None, progress: Callable[[int, int], None]) -> None:
    """Download into `part`, going on where it ends.

    Raises:
        OSError, HTTPException: the download failed, or is longer than `most` bytes.
    """
    there = part.stat().st_size if part.exists() else 0
    if most is not None and there > most:
        part.unlink()
        there = 0
    request = urllib.request.Request(url)
    if there:
        request.add_header("Range", f"bytes={there}-")
    try:
        with _open(request) as answer:
            given = _range_of(answer)
            mode = "ab" if given.start == there and there else "wb"
            if mode == "wb" and given.start:
                raise OSError(f"the server sent bytes from {given.start} on, not all")
            done = there if mode == "ab" else 0
            with part.open(mode) as file:
                while chunk := answer.read(CHUNK_BYTES):
                    done += len(chunk)
                    if most is not None and done > most:
                        break
                    file.write(chunk)
                    progress(done, given.total)
    except HTTPError as error:
        if error.code != 416:
            raise
        error.close()  # nothing lies behind the end: the file is there as a whole
        return
    if most is not None and done > most:
        part.unlink()
        raise OSError(f"the file is longer than {most} bytes, which is its pinned or largest size")
    if done < given.total:
        raise OSError(f"the connection ended after {done} of {given.total} bytes")


def _range_of(answer: HTTPResponse) -> _Range:
    length = int(answer.headers.get("Content-Length") or 0)
    if answer.status == 206:
        found = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", answer.headers.get("Content-Range", ""))
        if found is None:
            raise OSError("the server sent a part of the file without its place")
        start = int(found[1])
        return _Range(start, start + length if found[2] == "*" else int(found[2]))
    return _Range(0, length)


def _extract(name: str, file: CheckpointFile, archive: Path, path: Path) -> None:
    """Write one file of a zip archive to `path`, at most as large as pinned.

    Raises:
        InputError: the archive is damaged, or has no or several such files; it is removed.
    """
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
