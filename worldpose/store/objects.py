"""Project in S3-compatible object storage."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import cached_property
from pathlib import Path

from worldpose.errors import InputError, NondeterminismError, StoreError
from worldpose.store.blobs import Entry, pass_commit_point, storage_errors
from worldpose.store.paths import checked_path

try:
    import obstore
    from obstore.exceptions import AlreadyExistsError, BaseError
    from obstore.store import S3Store
except ImportError as error:
    raise InputError(
        "project on s3://",
        expected="the extra worldpose[s3]",
        found=f"no module {error.name}",
        todo="Run: pip install 'worldpose[s3]'.",
    ) from error

LISTINGS = 100
"""Folders of two parts, such as `runs/final`, of which each is listed alone."""


@dataclass(frozen=True)
class ObjectBlobs:
    """Objects below `prefix` of `bucket`; AWS_* variables have endpoint, region, credentials."""

    bucket: str
    prefix: str

    @classmethod
    def at(cls, url: str) -> ObjectBlobs:
        """Open the root `s3://bucket/prefix`; InputError without a bucket."""
        bucket, _, prefix = url.removeprefix("s3://").strip("/").partition("/")
        if not bucket:
            raise InputError(
                f"project {url}",
                expected="s3://bucket/prefix",
                found="no bucket",
                todo="Name the bucket after s3://.",
            )
        return cls(bucket, checked_path(prefix) if prefix else "")

    @property
    def url(self) -> str:
        """The root: `s3://bucket/prefix`."""
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")

    def read(self, path: str) -> bytes | None:
        """See `Blobs`."""
        with self._errors(path):
            try:
                return bytes(obstore.get(self._s3, checked_path(path)).bytes())
            except FileNotFoundError:
                return None

    def read_range(self, path: str, start: int, stop: int) -> bytes | None:
        """See `Blobs`."""
        with self._errors(path):
            try:
                return bytes(obstore.get_range(self._s3, checked_path(path), start=start, end=stop))
            except FileNotFoundError:
                return None
            except BaseError:
                # The service refuses a range beyond the end of an object, which was cut then.
                if obstore.head(self._s3, checked_path(path))["size"] >= stop:
                    raise
                return (self.read(path) or b"")[start:stop]

    def digest(self, path: str) -> tuple[int, str] | None:
        """See `Blobs`."""
        size, sha256 = 0, hashlib.sha256()
        with self._errors(path):
            try:
                content = obstore.get(self._s3, checked_path(path))
            except FileNotFoundError:
                return None
            for piece in content.stream():
                size += len(piece)
                sha256.update(piece)
        return size, sha256.hexdigest()

    def exists(self, path: str) -> bool:
        """See `Blobs`."""
        with self._errors(path):
            try:
                obstore.head(self._s3, checked_path(path))
            except FileNotFoundError:
                return False
            return True

    def put_new(self, path: str, data: bytes) -> bool:
        """See `Blobs`. The service refuses a second creation (If-None-Match)."""
        with self._errors(path):
            try:
                obstore.put(self._s3, checked_path(path), data, mode="create", use_multipart=False)
            except AlreadyExistsError:
                return False
            return True

    def put(self, path: str, data: bytes) -> None:
        """See `Blobs`."""
        with self._errors(path):
            obstore.put(self._s3, checked_path(path), data, use_multipart=False)

    def delete(self, path: str) -> None:
        """See `Blobs`."""
        with self._errors(path):
            obstore.delete(self._s3, checked_path(path))

    def delete_tree(self, prefix: str, first: str) -> None:
        """See `Blobs`."""
        self.delete(f"{prefix}/{first}")
        paths = [entry.path for entry in self.entries(prefix)]
        with self._errors(prefix):
            if paths:
                obstore.delete(self._s3, paths)

    def entries(self, prefix: str) -> list[Entry]:
        """See `Blobs`."""
        return self._list_objects(checked_path(prefix))

    def marks(self, paths: Sequence[str]) -> list[int]:
        """See `Blobs`. Few listings: of the first folders if there are many of two parts."""
        parts = [path.split("/") for path in paths]
        tops = {"/".join(p[: 1 if len(p) == 2 and "." in p[1] else 2]) for p in parts}
        if len(tops) > LISTINGS:
            tops = {top.partition("/")[0] for top in tops}
        below: dict[str, list[str]] = {path: [] for path in paths}
        for top in tops:
            for entry in self.entries(top):
                line, names = f"{entry.path} {entry.size} {entry.modified}", entry.path.split("/")
                for end in range(1, len(names) + 1):
                    below.get("/".join(names[:end]), []).append(line)
        texts = ("\n".join(below[path]).encode() for path in paths)
        return [int.from_bytes(hashlib.sha256(it).digest()[:7]) if it else 0 for it in texts]

    def all_entries(self) -> list[Entry]:
        """Return all objects below the root, sorted by path; any program can have named them."""
        return self._list_objects(None)

    def download(self, path: str, file: Path) -> None:
        """Write the object at `path` to a new file, piece by piece, since it can be a video."""
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("xb") as content:
            for piece in self._pieces(path):
                content.write(piece)

    def _pieces(self, path: str) -> Iterator[obstore.Bytes]:
        with self._errors(path):
            yield from obstore.get(self._s3, checked_path(path)).stream()

    def _list_objects(self, prefix: str | None) -> list[Entry]:
        with self._errors(prefix or ""):
            return sorted(
                (
                    Entry(item["path"], item["size"], item["last_modified"])
                    for page in obstore.list(self._s3, prefix)
                    for item in page
                ),
                key=lambda entry: entry.path,
            )

    def create_staging(self) -> Path:
        """See `Blobs`. On this machine's temporary disk."""
        with storage_errors(tempfile.gettempdir()):
            return Path(tempfile.mkdtemp(prefix="worldpose-"))

    def staged_entries(self) -> list[Entry]:
        """See `Blobs`. Always empty: staging is on the writers' own machines."""
        return []

    def publish_tree(self, folder: Path, prefix: str, manifest_name: str, manifest: bytes) -> bool:
        """See `Blobs`. Objects first, each created once; the manifest's creation publishes.

        NondeterminismError if an interrupted writer left other bytes for the same result.
        """
        if self.exists(f"{prefix}/{manifest_name}"):
            return False
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        # Concurrent uploads per result; the result exists only after the last.
        parallel_uploads = 8
        with storage_errors(str(folder)), ThreadPoolExecutor(parallel_uploads) as uploads:
            names = [f"{prefix}/{path.relative_to(folder).as_posix()}" for path in paths]
            for _ in uploads.map(self._put_same, names, paths):
                pass_commit_point("during_publish")
        pass_commit_point("before_commit")
        return self.put_new(f"{prefix}/{manifest_name}", manifest)

    def _put_same(self, path: str, source: Path) -> None:
        data = source.read_bytes()
        if not self.put_new(path, data) and self.read(path) != data:
            raise NondeterminismError(
                f"{self.url}/{path}: an interrupted writer of the same key left a file with other "
                "bytes, so the computation is not deterministic. Remove the leftovers with "
                "`worldpose gc` and report the stage."
            )

    @cached_property
    def _s3(self) -> S3Store:
        with self._errors(""):
            return S3Store(
                self.bucket,
                prefix=self.prefix or None,
                # Local S3 servers use http; the default endpoint is https.
                client_options={"allow_http": True},
                retry_config={"max_retries": 5, "retry_timeout": timedelta(seconds=30)},
            )

    @contextmanager
    def _errors(self, path: str) -> Iterator[None]:
        try:
            yield
        except (BaseError, ValueError, OSError) as error:
            what = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise StoreError(
                f"{self.url}/{path}: {what}. Check the bucket, AWS_ENDPOINT_URL, AWS_REGION and "
                "the credentials, and run again. Published results are unchanged."
            ) from error
