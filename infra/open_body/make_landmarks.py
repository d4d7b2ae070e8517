"""Prints the table of surface landmarks of the open body (`worldpose.body.keypoints`).

    python infra/open_body/make_landmarks.py [--pairs 32]

Pairs of mirrored vertices are chosen one after the other, each as far from all chosen ones as
possible, on the unposed surface without hands and toes, whose bend no pose coordinate describes.
So they cover every segment evenly. Names are side, segment and number from the top of the segment
down.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial import cKDTree

from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import JOINT_NAMES

SEGMENTS = {
    "head": ("head", "neck"),
    "trunk": ("spine1", "spine2", "spine3", "left_collar", "right_collar"),
    "pelvis": ("pelvis",),
    "upper_arm": ("left_shoulder", "right_shoulder"),
    "forearm": ("left_elbow", "right_elbow"),
    "thigh": ("left_hip", "right_hip"),
    "shank": ("left_knee", "right_knee"),
    "foot": ("left_ankle", "right_ankle"),
}
"""Joints of the segments that have landmarks."""
MIN_ASIDE_M = 0.02
"""Smallest distance of a landmark from the middle plane: both of a pair must differ [m]."""
MAX_UNLIKE_M = 0.002
"""Largest distance of a vertex from its partner's mirror image [m]."""


def choose(pairs: int) -> dict[str, list[tuple[int, int]]]:
    """Return the left and right vertex by the name without its side."""
    model = load_open_body()
    segment_of = {joint: name for name, joints in SEGMENTS.items() for joint in joints}
    owner = [segment_of.get(JOINT_NAMES[joint]) for joint in model.weights.argmax(axis=1)]
    away, partner = cKDTree(model.template).query(model.template * [-1.0, 1.0, 1.0])
    usable = np.array([name is not None for name in owner])
    usable &= (model.template[:, 0] > MIN_ASIDE_M) & (away < MAX_UNLIKE_M)
    usable &= partner[partner] == np.arange(len(partner))
    candidates = np.flatnonzero(usable)
    places = model.template[candidates]
    # The first is the lowest point of the back of the head; any other start gives as even a spread.
    chosen = [int(np.abs(places - [0.05, 0.45, -0.05]).sum(axis=1).argmin())]
    nearest = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < pairs:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
    found: dict[str, list[tuple[int, int]]] = {}
    for name in SEGMENTS:
        own = [int(candidates[k]) for k in chosen if owner[candidates[k]] == name]
        along = 2 if name == "foot" else 0 if "arm" in name else 1
        own.sort(key=lambda vertex: -model.template[vertex, along])
        found[name] = [(vertex, int(partner[vertex])) for vertex in own]
    return found


def main() -> None:
    """Print the entries."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=32)
    for name, pairs in choose(parser.parse_args().pairs).items():
        print(f'    "{name}": {tuple(pairs)},')


if __name__ == "__main__":
    main()
