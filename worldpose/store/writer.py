"""Writer of one result before its publication."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_contracts.arrays import GroupLayout
from data_contracts.records import CONTRACT_VERSION
from data_contracts.run import ResultManifest, StoredFile
from data_contracts.work import Work
from worldpose.errors import InternalError, StoreError
from worldpose.store.blobs import pass_commit_point, storage_errors
from worldpose.store.documents import canonical_json, digest, record_checksum

if TYPE_CHECKING:
    from worldpose.store.groups import Arrays


class ResultWriter:
    """Writes the arrays and metrics of one result to private staging.

    Attributes:
        figures: quality metrics by name, with the unit in the name; fill it before leaving
            `Store.publish`.
        left_out: static cameras that later stages must not use, by id, with the reason; the stage
            must have `Stage.leaves_out`. See `flows.left_out`.
        warnings: sentences that the run prints at its end.
        manifest: the published result's manifest; None until `Store.publish` ends.
    """

    def __init__(self, work: Work, folder: Path) -> None:
        self.figures: dict[str, float] = {}
        self.left_out: dict[str, str] = {}
        self.warnings: list[str] = []
        self.manifest: ResultManifest | None = None
        self._work, self._folder = work, folder
        self._started = time.monotonic()
        self._files = 0

    def write(
        self,
        layout: GroupLayout,
        arrays: Arrays,
        coordinates: Arrays | None = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> None:
        """Write the result's arrays, once; see `worldpose.store.groups.write_group`.

        StoreError if the disk is full or not writable, or the result was written already.
        """
        # Imported here: status and resumed runs need only manifests, and Zarr takes most of a
        # second.
        from worldpose.store.groups import write_group

        name = self._work.recipe.name
        if self._files:
            raise StoreError(
                f"{name}: a result is written only once, and this one has been written already. "
                "Pass all arrays to one call of ResultWriter.write."
            )
        if layout.stage != self._work.recipe.stage:
            raise InternalError(
                f"result of {name}",
                f"expected the layout of stage {self._work.recipe.stage}, found the layout of "
                f"stage {layout.stage}",
            )
        pass_commit_point("before_write")
        with storage_errors(str(self._folder)):
            self._files = write_group(
                self._folder, layout, arrays, coordinates or {}, attributes or {}
            )
        pass_commit_point("after_write")

    def sealed_manifest(self) -> ResultManifest:
        """Return the manifest of the written files; InternalError if a metric is not finite.

        StoreError if nothing was written, or files are missing.
        """
        name = self._work.recipe.name
        if not self._files:
            raise StoreError(
                f"{name}: the stage wrote no arrays, so there is nothing to publish. Call "
                "ResultWriter.write before the block of Store.publish ends."
            )
        for metric, value in self.figures.items():
            if not math.isfinite(value):
                raise InternalError(
                    f"metric {metric} of {name}", f"expected a finite number, found {value}"
                )
        with storage_errors(str(self._folder)):
            files = stored_files(self._folder)
        if len(files) != self._files:
            raise StoreError(
                f"{self._folder}: {name} has {self._files} files, but only {len(files)} of "
                "them exist, so nothing was published. Another program removed the others. Run "
                "again."
            )
        manifest = ResultManifest(
            contract=CONTRACT_VERSION,
            key=self._work.key,
            recipe=self._work.recipe,
            files=files,
            content=content_digest(files),
            figures={metric: float(value) for metric, value in self.figures.items()},
            left_out=dict(sorted(self.left_out.items())),
            warnings=tuple(self.warnings),
            created_at=datetime.now(UTC),
            seconds=time.monotonic() - self._started,
            run_id=self._work.run_id,
            checksum="0" * 64,
        )
        return manifest.model_copy(update={"checksum": record_checksum(manifest)})


def stored_files(folder: Path) -> tuple[StoredFile, ...]:
    """Return size and checksum of every file below `folder`, sorted by path."""
    # Threads that hash the files of one result; the units of other workers do so, too.
    digest_threads = 2

    def describe(path: Path) -> StoredFile:
        data = path.read_bytes()
        name = path.relative_to(folder).as_posix()
        return StoredFile(path=name, size=len(data), sha256=digest(data))

    # Hashing leaves the interpreter to other threads.
    with ThreadPoolExecutor(digest_threads) as threads:
        found = list(threads.map(describe, filter(Path.is_file, folder.rglob("*"))))
    return tuple(sorted(found, key=lambda file: file.path))


def content_digest(files: tuple[StoredFile, ...]) -> str:
    """Return a digest that is equal for all valid computations of one key."""
    return digest(canonical_json([file.model_dump(mode="json") for file in files]))
