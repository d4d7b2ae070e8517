"""What a run and its own Prefect server, alone on a machine, are spared."""

import gc
import importlib
import sqlite3
import ssl
from contextlib import closing

import pytest

from flows import prefect_database
from flows.operations.plan import ServePlan
from flows.operations.serving import environment_of
from flows.prefect_database import DATABASE, begin_database, keep_database
from flows.prefect_environment import AUTHORITIES, one_authority, prefect_server
from worldpose.errors import StoreError


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Where the empty database is kept, of which there is none yet."""
    file = tmp_path / "installation" / "prefect.db"
    monkeypatch.setattr(prefect_database, "kept_database", lambda: file)
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    return file


def tables(database):
    with closing(sqlite3.connect(database)) as opened:
        assert opened.execute("pragma integrity_check").fetchone() == ("ok",)
        return set(opened.execute("select type, name, sql from sqlite_master"))


def test_what_the_first_server_makes_all_later_ones_begin_with(tmp_path, kept):
    first, second = tmp_path / "first", tmp_path / "second"
    with prefect_server(str(first), is_local=True) as wait_until_ready:
        wait_until_ready()
        made = tables(first / "prefect" / DATABASE)
    assert len(made) > 50
    assert [file.name for file in kept.parent.iterdir()] == [kept.name]
    with prefect_server(str(second), is_local=True) as wait_until_ready:
        assert tables(second / "prefect" / DATABASE) == made  # before the server is up
        wait_until_ready()
    assert tables(kept) == made


def test_a_database_that_is_there_stays(tmp_path, kept):
    kept.parent.mkdir()
    kept.write_bytes(b"empty")
    (tmp_path / DATABASE).write_bytes(b"full")
    assert not begin_database(tmp_path)
    assert (tmp_path / DATABASE).read_bytes() == b"full"


def test_without_a_place_to_keep_it_every_server_makes_its_own(tmp_path, kept):
    kept.parent.touch()  # a file where the folder should be
    assert begin_database(tmp_path)
    (tmp_path / DATABASE).touch()
    keep_database(tmp_path)
    assert begin_database(tmp_path / "another")


def test_a_project_in_which_no_server_can_write_says_what_to_do(tmp_path, kept):
    (tmp_path / "prefect").touch()  # a file where the folder should be
    with (
        pytest.raises(StoreError, match=r"prefect: File exists.*run again.*results are untouched"),
        prefect_server(str(tmp_path), is_local=True),
    ):
        pass


def test_a_database_elsewhere_is_not_kept(tmp_path, kept):
    keep_database(tmp_path)
    assert not kept.exists()


def test_one_authority_is_read_instead_of_all(tmp_path, monkeypatch):
    monkeypatch.delenv(AUTHORITIES, raising=False)
    file = one_authority(tmp_path)[AUTHORITIES]
    assert len(ssl.create_default_context(cafile=file).get_ca_certs()) == 1
    monkeypatch.setenv(AUTHORITIES, "/of/somebody.pem")
    assert one_authority(tmp_path)[AUTHORITIES] == "/of/somebody.pem"


def test_only_those_on_this_machine_who_talk_plainly_are_given_it(tmp_path, monkeypatch):
    monkeypatch.delenv(AUTHORITIES, raising=False)
    own = {"prefect": "http://127.0.0.1:4200/api"}
    plan = ServePlan(project=str(tmp_path), inbox=tmp_path, state=tmp_path, **own)
    assert AUTHORITIES in environment_of(plan)
    # Workers elsewhere do not see the file, and another's server may be one with TLS.
    for other in ({"dask": "tcp://far:8786"}, {"owns_prefect": False}):
        assert AUTHORITIES not in environment_of(plan.model_copy(update=other))


def test_workers_collect_no_garbage_until_they_have_imported_all():
    try:
        preload = importlib.import_module("tasks.preload")
        importlib.reload(preload)  # whether or not something had imported it
        assert not gc.isenabled()
        preload.dask_setup(None)
        assert gc.isenabled()
        assert gc.get_freeze_count() > 0
    finally:
        gc.enable()
        gc.unfreeze()
