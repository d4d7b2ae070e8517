"""A project in object storage: the same commands, the same bytes."""

import uuid

import pytest
from command_line import TINY, succeed
from store_comparison import compare_stores

from flows import layers
from flows.layers import write_layer
from flows.settings import resolve
from worldpose import open_run
from worldpose.store.integrity import verify
from worldpose.store.store import Store


@pytest.mark.slow
def test_a_match_run_on_object_storage_equals_one_on_disk(server, bucket, tiny, tiny_run):
    project = f"{bucket}/{uuid.uuid4().hex}"
    succeed("run", tiny, "--project", project)
    assert compare_stores(Store.open(project), Store.open(str(tiny_run))) == []
    assert verify(Store.open(project)) == ()
    joints = open_run(project, TINY)["triangulation/clip"].joints
    assert joints.attrs["units"] == "m"
    again = succeed("run", tiny, "--project", project, "--json").json
    assert (again["run"], again["executed"]) == ("0001", 0)


def test_layers_are_kept_in_object_storage_too(bucket):
    store = Store.create(f"{bucket}/layers")
    write_layer(store, "venues/hall", {"lenses": [], "tracking.gate_m": 0.6})
    write_layer(store, "project", {"iterations": "auto"})
    assert layers.list_venues(store) == ("hall",)
    assert resolve(layers.project_layers(store)).general.iterations == "auto"
    write_layer(store, "project", {})
    (entry,) = store.blobs.entries("settings")
    assert entry.path == "settings/venues/hall.yaml"
