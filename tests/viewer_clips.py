"""Clips for tests of the 3D viewer, without a run."""

from dataclasses import replace

import numpy as np

from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyParameters
from worldpose.formats.viewer_file import ViewerClip, ViewerPerson
from worldpose.geometry.cameras import Camera

LOOKS_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
INTRINSICS = np.array([[2000.0, 0.0, 959.5], [0.0, 2000.0, 539.5], [0.0, 0.0, 1.0]])
CENTER = np.array([0.0, -60.0, 12.0])


def camera(*batch):
    rotation = np.broadcast_to(LOOKS_ALONG_Y, (*batch, 3, 3))
    return Camera.from_matrices(
        np.broadcast_to(INTRINSICS, (*batch, 3, 3)),
        np.zeros((*batch, 5)),
        rotation,
        -(rotation @ CENTER),
        np.array([1920, 1080]),
    )


def motion(rng, frames, people):
    """Bodies with random poses that change by some degrees from frame to frame."""

    def wander(size, step):
        return np.cumsum(rng.normal(0.0, step, (frames, people, size)), axis=0)

    start = rng.uniform(-1.0, 1.0, (people, 3)) * [45.0, 30.0, 0.0] + [0.0, 0.0, 1.0]
    return BodyParameters(
        rng.standard_normal((1, people, 10)),
        rng.uniform(-3.0, 3.0, (people, 3)) + wander(3, 0.05),
        rng.uniform(-1.0, 1.0, (people, 69)) + wander(69, 0.02),
        start + wander(3, 0.1) * [1.0, 1.0, 0.02],
    )


def bodies_clip(frames=60, people=2, seed=0, fps=50.0):
    """People with bodies; the first one is missing in frames 5 to 8."""
    rng = np.random.default_rng(seed)
    bodies = motion(rng, frames, people)
    transl = bodies.transl.copy()
    transl[5:9, 0] = np.nan
    line = np.array([[-52.5, -34.0, 0.0], [0.0, -34.0, 0.0], [52.5, -34.0, 0.0], [52.5, 34.0, 0.0]])
    return ViewerClip(
        clip="half",
        fps=fps,
        frames=np.arange(100, 100 + frames),
        people=tuple(
            ViewerPerson(7 + n, f"<Player {n}>", "triangulated", "AB"[n % 2], "#0072b2")
            for n in range(people)
        ),
        joints=np.full((frames, people, 17, 3), np.nan),
        spread=np.exp(rng.uniform(np.log(0.002), np.log(0.5), (frames, people, 17))),
        views=rng.integers(0, 12, (frames, people, 17)),
        ground=np.full((frames, people, 3), np.nan),
        height=np.full(people, np.nan),
        bodies=BodyParameters(bodies.betas, bodies.global_orient, bodies.body_pose, transl),
        model=load_open_body(),
        cameras={"north": camera()},
        moving={"broadcast": camera(frames)},
        markings=[line],
        notes={"match": "m & n", "run": "0001", "licence": "For tests alone."},
    )


def mixed_clip(frames=60):
    """A body, a person of whom only joints are known, and one whom only the feet place."""
    clip = bodies_clip(frames, 3)
    parts = (clip.bodies.betas, clip.bodies.global_orient, clip.bodies.body_pose)
    transl = clip.bodies.transl.copy()
    transl[:, 0] += [5.0, 0.0, 0.0] - transl[:1, 0]
    transl[:, 1:] = np.nan
    rng = np.random.default_rng(1)
    joints, ground = clip.joints.copy(), clip.ground.copy()
    upright = rng.uniform(-0.4, 0.4, (17, 3)) + [-3.0, 2.0, 1.0]
    joints[:, 1] = upright + np.linspace(0.0, 3.0, frames)[:, None, None] * [1.0, 0.0, 0.0]
    joints[:, 1, 3] = np.nan
    ground[:, 2] = [1.0, -6.0, 0.25]
    ground[2, 2] = np.nan
    people = list(clip.people)
    people[2] = replace(people[2], kind="plane", name="", team="")
    height = np.array([np.nan, np.nan, 1.75])
    return replace(
        clip,
        bodies=BodyParameters(*parts, transl),
        joints=joints,
        ground=ground,
        people=tuple(people),
        height=height,
    )
