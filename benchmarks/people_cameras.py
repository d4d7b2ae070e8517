"""Prints the distance of one calibration's cameras from those of another.

    worldpose import --pose2sim TRIAL --out MATCH       # a trial without its calibration
    worldpose import --lens lenses.toml --out MATCH
    worldpose locate-cameras MATCH --stature 1.75 --out found.toml
    python benchmarks/people_cameras.py found.toml given.toml

Both files have the same names. The found cameras are aligned with the given ones by a similarity
transform of their positions: people tell neither place nor direction of the given world, and a
stature tells its scale within some per cent.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import worldpose
from worldpose.bundle_adjustment.adjustment import camera_motion
from worldpose.bundle_adjustment.uncertainty import Similarity
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import align


def main() -> None:
    """Print position, orientation and focal length of each camera against the given one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("found", type=Path)
    parser.add_argument("given", type=Path)
    asked = parser.parse_args()
    found, given = (worldpose.read_cameras(file) for file in (asked.found, asked.given))
    names = [name for name in given if name in found]
    cameras = Camera.stack([found[name] for name in names])
    right = Camera.stack([given[name] for name in names])
    motion = align(cameras.center, right.center, with_scale=True)
    moved = Similarity(float(motion.scale), motion.rotation, motion.translation)
    off = camera_motion(moved.move_cameras(cameras), right)
    up = float(np.degrees(np.arccos(np.clip(motion.rotation[2, 2], -1.0, 1.0))))
    print(f"scale {float(motion.scale):.3f}, vertical off by {up:.1f} degrees")
    for name, (place, turn, focal) in zip(names, off.tolist(), strict=True):
        print(
            f"{name:12s} position {100 * place:6.1f} cm, orientation {np.degrees(turn):5.2f} deg, "
            f"focal length {100 * focal:+5.1f} %"
        )


if __name__ == "__main__":
    main()
