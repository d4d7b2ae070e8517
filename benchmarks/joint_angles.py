"""Scores the joint angles of fitted bodies against those of a simulated match's true bodies.

    python benchmarks/joint_angles.py PROJECT MATCH [PROJECT MATCH ...]

MATCH is a folder of `worldpose simulate`, PROJECT one with its run. Angles are those of `mot`
(docs/reference/formats.md). Per angle [deg] and position [mm], over all matches: the root mean
square error, and the mean error with its standard error from the spread between people, since
frames of one person share it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from data_contracts.arrays import Floats
from flows.results.best_results import bodies_unit, fitted_bodies
from worldpose import open_run
from worldpose.body.body_file import find_body
from worldpose.evaluation.matching import match_people
from worldpose.formats.joints_file import read_joints, read_poses
from worldpose.formats.motion_capture import OPENSIM_COORDINATES, opensim_coordinates
from worldpose.ingest.match_folder import read_match

ANGLES = np.array([not name.startswith("pelvis_t") for name in OPENSIM_COORDINATES])
ANGLES[OPENSIM_COORDINATES.index("pelvis_tilt")] = True
"""(27,) whether a coordinate is an angle [deg] or a position [m]."""
NEAR_M = 0.3
"""Largest median distance of a body from the true person's [m]."""


def errors_of(project: str, folder: Path) -> list[Floats]:
    """Return each person's errors (frames, 27) [deg, mm] over the frames with a body."""
    match_id = read_match(folder).spec.match_id
    run = open_run(project, match_id)
    found = []
    for path in sorted((folder / "reference" / "poses").glob("*.npz")):
        clip = path.stem
        true, name = read_poses(path)
        assert name is not None, f"{path} does not name its body model"
        model, fitted, _ = fitted_bodies(run, clip)
        frames = run[bodies_unit(run, clip)]["frame"].values
        first = int(read_joints(folder / "reference" / "joints.npz").frames[0])
        rows = frames - first
        way = fitted.transl[None] - true.transl[:, None, rows]
        apart = np.nanmedian(np.linalg.norm(way, axis=-1), axis=-1)
        apart[~np.isfinite(apart)] = np.inf
        (partner,) = match_people(apart[None], NEAR_M)
        for k in np.flatnonzero(partner >= 0).tolist():
            n = int(partner[k])
            there = np.isfinite(fitted.transl[n]).all(axis=-1) & np.isfinite(
                true.transl[k][rows]
            ).all(axis=-1)
            ours = opensim_coordinates(model, fitted[n, there])
            theirs = opensim_coordinates(find_body(name), true[k, rows[there]])
            error = ours - theirs
            error[:, ANGLES] = (error[:, ANGLES] + 180.0) % 360.0 - 180.0
            error[:, ~ANGLES] *= 1000.0
            found.append(error)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", metavar="PROJECT MATCH")
    given = parser.parse_args().runs
    errors = []
    for project, folder in zip(given[::2], given[1::2], strict=True):
        errors += errors_of(project, Path(folder))
    poses = np.concatenate(errors)
    means = np.stack([error.mean(axis=0) for error in errors])
    print(f"{len(errors)} people, {len(poses)} poses")
    print(f"{'angle':18s} {'rms':>7s} {'mean':>7s} {'its std':>8s}")
    for column, name in enumerate(OPENSIM_COORDINATES):
        print(
            f"{name:18s} {np.sqrt(np.mean(poses[:, column] ** 2)):7.2f} "
            f"{means[:, column].mean():7.2f} "
            f"{means[:, column].std(ddof=1) / np.sqrt(len(errors)):8.2f}"
        )


if __name__ == "__main__":
    main()
