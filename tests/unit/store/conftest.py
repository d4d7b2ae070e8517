import tempfile
import uuid

import pytest
from store_samples import SMALL_CHUNK, SMALL_SHARD

import data_contracts.arrays
from worldpose.store.blobs import install_fault_hook
from worldpose.store.store import Store


@pytest.fixture(params=["folder", "s3"])
def url(request):
    """Where a project can be made: every test that takes it runs on disk and on S3."""
    if request.param == "s3":
        return f"{request.getfixturevalue('bucket')}/{uuid.uuid4().hex}"
    return str(request.getfixturevalue("tmp_path") / "project")


@pytest.fixture
def store(url):
    return Store.create(url)


@pytest.fixture
def folder_store(tmp_path):
    """For what does not depend on the medium: S3 tests cost ten times as much."""
    return Store.create(tmp_path / "project")


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch, tmp_path):
    monkeypatch.setattr(data_contracts.arrays, "CHUNK_BYTES", SMALL_CHUNK)
    monkeypatch.setattr(data_contracts.arrays, "SHARD_CHUNKS", SMALL_SHARD)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    yield
    install_fault_hook(None)
