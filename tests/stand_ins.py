"""Placeholder results, for tests of decisions that depend on keys alone."""

import tempfile
from datetime import UTC, datetime
from functools import cache

from data_contracts.records import CONTRACT_VERSION
from data_contracts.run import ResultManifest
from worldpose.store.documents import digest, record_checksum, seal
from worldpose.store.paths import MANIFEST, ResultId
from worldpose.store.store import Store
from worldpose.store.writer import content_digest, stored_files


@cache
def empty_store():
    """A project without matches, for results that nobody names or corrects."""
    return Store.create(f"{tempfile.mkdtemp()}/project")


def publish_stand_in(store, match, unit, files=("zarr.json",)):
    """Publish a planned unit without computing it, with a placeholder per name in `files`."""
    folder = store.blobs.create_staging()
    for name in files:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{unit.name} {name}")
    stored = stored_files(folder)
    manifest = ResultManifest(
        contract=CONTRACT_VERSION,
        key=unit.key,
        recipe=unit.recipe,
        files=stored,
        content=content_digest(stored),
        figures={},
        created_at=datetime.now(UTC),
        seconds=1.0,
        run_id="0001",
        checksum=digest(b""),
    )
    manifest = manifest.model_copy(update={"checksum": record_checksum(manifest)})
    path = ResultId.for_work(unit.work(store.url, match, "0001")).path
    assert store.blobs.publish_tree(folder, path, MANIFEST, seal(manifest))
