"""Writes worldpose/body_fitting/pose_prior.npz: distribution of the simulated people's poses.

    python infra/pose_prior/make_pose_prior.py worldpose/body_fitting/pose_prior.npz

Mean and covariance of the 30 coordinates of `worldpose.body_fitting.pose_space`, of every person of
seven simulated clips at 5 frames per second and of their mirror images. The seeds are far from
those of tests and benchmarks. It contains no motion capture.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from worldpose.body_fitting.pose_space import COORDINATES, GATHER, SIZE
from worldpose.formats.archives import write_archive
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.crowd import gather
from worldpose.simulation.scenarios import SCENARIOS

CLIPS = (
    ("match", 24.0, 9001),
    ("match", 24.0, 9002),
    ("crossing", 6.0, 9003),
    ("corner-kick", 8.0, 9004),
    ("penalty-box", 12.0, 9005),
    ("penalty-box", 12.0, 9006),
    ("tiny", 12.0, 9007),
)
"""Scenario, length [s] and seed."""


def main(out: Path) -> None:
    """Simulate, and write the distribution."""
    poses = []
    for name, duration, seed in CLIPS:
        scenario = SCENARIOS[name].model_copy(update={"duration": duration})
        (people,) = np.random.SeedSequence(seed).spawn(1)
        crowd = gather(scenario, PitchTemplate.from_spec(scenario.pitch), people)
        poses.append(crowd.poses(np.arange(0.0, duration, 0.2)).body_pose.reshape(-1, 69))
    coordinates = np.concatenate(poses) @ GATHER.T
    names = [joints[0] for joints in COORDINATES]
    other = [
        names.index(name.replace("left", "*").replace("right", "left").replace("*", "right"))
        for name in names
    ]
    mirrored = coordinates.reshape(-1, len(names), 3)[:, other] * [1.0, -1.0, -1.0]
    both = np.concatenate([coordinates, mirrored.reshape(-1, SIZE)])
    write_archive(out, {"mean": both.mean(axis=0), "covariance": np.cov(both.T)})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
