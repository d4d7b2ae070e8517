"""Reconstruct a match folder in one script: from clicks and 2D poses (or videos) to bodies.

    worldpose simulate --scenario tiny --seed 1 --duration 1 --out match
    python examples/whole_match.py match joints.npz

The steps are those of worldpose/pipeline.py. `worldpose run match` gives the same bodies, and adds
given cameras, stills from the videos, fractions of a frame, checks, review, reruns and lineage.
"""

import sys

import worldpose as wp


def main() -> None:
    """Reconstruct the match."""
    folder, out = sys.argv[1:]
    found = wp.reconstruct(wp.read_match(folder))
    adjusted, person, bodies = found.adjusted.accepted, found.tracking.person, found.bodies
    print(f"{adjusted.sum()} of {len(adjusted)} cameras adjusted to people")
    joints = wp.JointTracks(found.frame, person, bodies.joints, bodies.covariance)
    wp.write_joints(out, joints)
    print(f"{len(person)} people in {len(found.frame)} frames: {out}")


if __name__ == "__main__":
    main()
