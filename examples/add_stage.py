"""A custom stage on the results of a run: each person's distance and speed.

    worldpose run match
    python examples/add_stage.py worldpose-data tiny-1-1s

Its key is the digest of its input, its settings and the version of this code: a second call finds
the result unless one of these has changed. CONTRIBUTING.md: how to add a stage to the method.
"""

import sys

import numpy as np

import worldpose as wp
from data_contracts.arrays import ArrayLayout, Floats, GroupLayout
from data_contracts.keypoints import FRAME
from data_contracts.tracking import PERSON
from data_contracts.work import Recipe, Work
from worldpose.store.recipes import libraries, recipe_key
from worldpose.store.store import Store

WINDOW_S = 0.4
SPEEDS = GroupLayout(
    stage="speeds",
    about="Speed and distance of every person.",
    coordinates=(FRAME, PERSON),
    arrays=tuple(
        ArrayLayout(name=name, dims=dims, dtype="float64", unit=unit, missing="nan", about=about)
        for name, dims, unit, about in [
            ("speed", ("frame", "person"), "m/s", "of the mid-hip over the ground"),
            ("distance", ("person",), "m", "covered in the clip"),
        ]
    ),
)


def main() -> None:
    """Compute the speeds of every clip of the latest run, or find them."""
    project, match = sys.argv[1:]
    run, store = wp.open_run(project, match), Store.open(project)
    fps = store.registration(match).spec.fps  # type: ignore[union-attr] # there is a run
    for name in filter(lambda name: name.startswith("body_fitting/"), run):
        unit = name.partition("/")[2]
        recipe = Recipe(
            match_id=match,
            stage="speeds",
            unit=unit,
            sources={"fps": fps},
            inputs={name: run.record.results[name]},
            settings={"window_s": WINDOW_S},
            code={"speeds": "2"},
            libraries=libraries(),
        )
        key = recipe_key(recipe)
        if not store.has(match, "speeds", unit, key):
            work = Work(project=project, folder="", recipe=recipe, key=key, run_id="0001")
            with store.publish(work) as result:
                bodies = run[name]
                speed, distance = measure_speeds(bodies.joints.values, fps)
                coordinates = {"frame": bodies.frame.values, "person": bodies.person.values}
                result.write(SPEEDS, {"speed": speed, "distance": distance}, coordinates)
        found = store.open_result(match, "speeds", unit, key)
        for person in found.person.values:
            one = found.sel(person=person)
            length, fastest = float(one.distance), float(one.speed.max())
            print(f"{unit} person {person}: {length:.1f} m, at most {fastest:.1f} m/s")


def measure_speeds(joints: Floats, fps: float) -> tuple[Floats, Floats]:
    """Return speeds (frames, persons) [m/s] and distances (persons,) [m] of joints in metres."""
    place: Floats = joints[:, :, 11:13, :2].mean(axis=2)
    half = max(1, round(WINDOW_S * fps / 2))
    speed = np.full(place.shape[:2], np.nan)
    step = np.linalg.norm(place[2 * half :] - place[: -2 * half], axis=-1)
    speed[half:-half] = step * fps / (2 * half)
    return speed, np.nansum(np.linalg.norm(np.diff(place, axis=0), axis=-1), axis=0)


if __name__ == "__main__":
    main()
