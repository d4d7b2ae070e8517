"""A small stage for the store's tests, and the processes that are killed while writing it."""

import multiprocessing
import os
import tempfile
from typing import Any

import numpy as np
from run_records import match_spec, run_record

import data_contracts.arrays
from data_contracts.arrays import GroupLayout, array_layout
from data_contracts.match import Registration, SourceFile
from data_contracts.work import Recipe, Work
from worldpose.store.blobs import install_fault_hook
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store

FRAMES, PERSONS = 40, 3
SMALL_CHUNK, SMALL_SHARD = 512, 2
"""[byte] and chunks per file: cuts the sample's joints into several chunks and files; real chunks
are 1 MiB and more."""

LAYOUT = GroupLayout(
    stage="tracking",
    about="Sample.",
    coordinates=(array_layout("frame", "(frame) int64 [frame]", "f"),),
    arrays=(
        array_layout(
            "joints", "(*frame, person, coordinate) float64 [m], missing nan", "joints, world"
        ),
        array_layout(
            "detection_index", "(*frame, camera) int16 [1], missing -1", "which detection"
        ),
        array_layout("views", "(frame) uint8 [1], missing 0", "how many cameras"),
        array_layout("inliers", "(frame, person) bool [1]", "is it good"),
        array_layout("height", "() float32 [m]", "one number"),
        array_layout("nothing", "(detection) float32 [px], missing nan", "no detections at all"),
        array_layout("extra", "(frame) int32 [1]", "rare"),
    ),
    labels={"coordinate": ("x", "y", "z")},
    attributes={"camera": "camera ids", "detector": "who detected"},
    optional=("extra", "inliers", "height", "nothing"),
)

ATTRIBUTES: dict[str, Any] = {"detector": "none", "camera": ["left", "right"]}


def sample_arrays(seed=0):
    """The arrays that cannot be left out: few files, as S3 tests pay by the file."""
    rng = np.random.default_rng(seed)
    joints = rng.normal(size=(FRAMES, PERSONS, 3))
    joints[3, 1] = np.nan
    return {
        "joints": joints,
        "detection_index": rng.integers(-1, 5, size=(FRAMES, 2), dtype=np.int16),
        "views": np.zeros(FRAMES, dtype=np.uint8),
    }


def all_sample_arrays():
    """An array of every kind."""
    return {
        **sample_arrays(),
        "inliers": np.arange(FRAMES * PERSONS).reshape(FRAMES, PERSONS) % 2 == 0,
        "height": np.array(1.8, dtype=np.float32),
        "nothing": np.zeros(0, dtype=np.float32),
    }


def sample_coordinates():
    return {"frame": np.arange(100, 100 + FRAMES)}


def sample_recipe(unit="clip", **changes):
    fields: dict[str, Any] = {
        "match_id": "final",
        "stage": "tracking",
        "unit": unit,
        "sources": {"pitch": "a" * 64},
        "inputs": {},
        "settings": {"gate": {"max_distance": 0.5}},
        "code": {"worldpose.tracking": "b" * 64},
        "libraries": {"numpy": "2.4.0"},
    }
    return Recipe(**(fields | changes))


def sample_work(store, recipe=None, run_id="0001"):
    recipe = recipe or sample_recipe()
    return Work(
        project=store.url, folder="/match", recipe=recipe, key=recipe_key(recipe), run_id=run_id
    )


def publish(store, recipe=None, seed=0, run_id="0001"):
    with store.publish(sample_work(store, recipe, run_id)) as writer:
        layout = LAYOUT.model_copy(update={"stage": (recipe or sample_recipe()).stage})
        writer.write(layout, sample_arrays(seed), sample_coordinates(), ATTRIBUTES)
        writer.figures["mean_views"] = 2.5
    return writer


def place(recipe=None):
    recipe = recipe or sample_recipe()
    return recipe.match_id, recipe.stage, recipe.unit, recipe_key(recipe)


def sample_record(run_id, *recipes, **changes):
    results = {recipe.name: recipe_key(recipe) for recipe in recipes}
    own = {"match_id": "final", "results": results, "executed": tuple(results)}
    return run_record(**({"run_id": run_id, **own} | changes))


def run_once(store, *recipes):
    """A whole run: what exists is reused, the rest computed, the record written."""
    recipes = recipes or (sample_recipe(),)
    run_id = store.reserve_run("final")
    for recipe in recipes:
        if not store.has(*place(recipe)):
            publish(store, recipe, run_id=run_id)
    store.finish_run(sample_record(run_id, *recipes))
    return run_id


def sample_registration(match_id="final", folder="/match"):
    spec = match_spec(["left"], {"clip": {"frame_count": FRAMES}}, match_id=match_id)
    source = SourceFile(path="match.yaml", size=3, modified_ns=1, sha256="c" * 64)
    return Registration(spec=spec, folder=folder, identity="d" * 64, files=(source,))


PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["pytest", "worldpose.store", "worldpose.store.groups", "obstore"])


def run_process(target, *arguments):
    """A started process that sees this one's object storage."""
    process = PROCESSES.Process(
        target=_with_environment,
        args=(
            {name: value for name, value in os.environ.items() if name.startswith("AWS_")},
            tempfile.gettempdir(),
            target,
            *arguments,
        ),
        daemon=True,
    )
    process.start()
    return process


def _with_environment(environment, temporary, target, *arguments):
    os.environ.update(environment)
    tempfile.tempdir = temporary
    data_contracts.arrays.CHUNK_BYTES = SMALL_CHUNK
    data_contracts.arrays.SHARD_CHUNKS = SMALL_SHARD
    target(*arguments)


def run_and_die(url, point, sabotage=None):
    """Runs the sample and dies, as from kill -9, the first time it is at `point`."""
    if sabotage:
        sabotage()
    install_fault_hook(lambda name: os._exit(9) if name == point else None)
    run_once(Store.open(url))
