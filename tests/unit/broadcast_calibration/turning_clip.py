"""A small clip for tests: a camera that pans and zooms over the pitch, and what is seen."""

import numpy as np

from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.broadcast_calibration.evidence import (
    MARKING,
    FlowEvidence,
    PointEvidence,
    whiten_across,
)
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.mannequins import dress_people
from worldpose.simulation.renderer import Moment, film_broadcast
from worldpose.simulation.scene import look_at
from worldpose.simulation.settings import RenderingSettings
from worldpose.simulation.venues import build_venue

PITCH = PitchTemplate.standard()
SIZE = (960, 540)
CENTER = np.array([0.5, -74.0, 16.0])
SHAPE = np.stack([np.tile([-0.2, 0.2], 9)[:17], np.zeros(17), np.linspace(0.1, 1.8, 17)], axis=-1)
"""Joints (17, 3) of a person at the origin [m]."""


def film_empty_pitch(cameras, seed, settings=None):
    """Images (height, width, 3) of a clip without people."""
    venue = build_venue(PITCH, seed, settings or RenderingSettings())
    cast = dress_people(np.empty((0, 10)), [], seed)
    nobody = cast.pose(BodyParameters(*(np.empty((0, n)) for n in (10, 3, BODY_POSE, 3))))
    moments = [Moment(cast, nobody, nobody)] * len(cameras.focal)
    return (each.image for each in film_broadcast(cameras, venue, moments))


def draw(true, frame, noise=0.0, rng=None):
    """The centre circle, halfway line and far touch line drawn in one frame."""
    drawn = []
    for name in ("center_circle", "halfway_line", "touch_line_far"):
        pixels = true.camera[frame].project(PITCH.marking_points(name, 0.5))
        inside = pixels[((pixels > 3.0) & (pixels < true.image_size - 4.0)).all(axis=-1)]
        some = inside[np.linspace(0, len(inside) - 1, 9).astype(int)]
        if rng is not None:
            some = some + noise * rng.standard_normal(some.shape)
        drawn.append({"name": name, "xy": some.tolist()})
    return drawn


def moving(frames=40, pan=(-3.0, 4.0), zoom=(1900.0, 2100.0), size=SIZE):
    """A camera that aims along x from one place to another while it zooms."""
    share = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, frames))
    aims = pan[0] + (pan[1] - pan[0]) * share
    focal = zoom[0] + (zoom[1] - zoom[0]) * share
    grown = focal / 2100.0
    poses = [look_at(CENTER, np.array([x, -2.0, 0.0]), 0.002) for x in aims]
    return MovingCamera(
        center=CENTER,
        principal_point=np.array([0.5 * size[0] - 2.0, 0.5 * size[1] - 14.0]),
        rotation=np.stack([pose.rotation for pose in poses]),
        focal=focal,
        distortion=np.stack([0.4 * grown**1.6, 1.5 * grown, 0.0 * grown], axis=-1),
        image_size=np.array(size),
    )


def ground_points(camera, rng, each=40, noise=0.3):
    """Return `each` random pitch points per frame, each measured across a random direction."""
    frames = len(camera)
    x, y = rng.uniform(-30.0, 30.0, 4000), rng.uniform(-30.0, 30.0, 4000)
    places = np.stack([x, y, PITCH.height(x, y)], axis=-1)
    seen = camera.camera.project(places)
    frame, which, image = [], [], []
    for t in range(frames):
        inside = np.flatnonzero(((seen[t] > 0) & (seen[t] < camera.image_size - 1)).all(-1))
        chosen = rng.choice(inside, each)
        frame.append(np.full(each, t))
        which.append(chosen)
        image.append(seen[t, chosen])
    frame, which, image = (np.concatenate(part) for part in (frame, which, image))
    turn = rng.uniform(0.0, np.pi, len(frame))
    normals = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return PointEvidence.observe(
        MARKING,
        frame,
        places[which],
        image + noise * rng.standard_normal(image.shape),
        whiten_across(normals, np.full(len(frame), noise)),
        source=np.zeros(len(frame), dtype=np.int64),
        loss=np.inf,
    )


def followed_points(camera, rng, each=60, noise=0.1):
    """Directions seen in neighbouring frames."""
    frames = len(camera) - 1
    start = rng.uniform([0.0, 0.0], camera.image_size - 1.0, (frames, each, 2))
    rays = camera.camera[:-1].unproject(start)
    end = camera.camera[1:].project(rays.origins + 100.0 * rays.directions)
    end = end + noise * rng.standard_normal(end.shape)
    return FlowEvidence(
        np.repeat(np.arange(frames), each),
        start.reshape(-1, 2),
        end.reshape(-1, 2),
        np.full(frames * each, noise),
    )
