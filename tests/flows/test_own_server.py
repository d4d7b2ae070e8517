"""What a run and its own Prefect server, alone on a machine, are spared."""

import gc
import importlib
import ssl

from flows.operations.plan import ServePlan
from flows.operations.serving import environment_of
from flows.prefect_environment import AUTHORITIES, one_authority


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
