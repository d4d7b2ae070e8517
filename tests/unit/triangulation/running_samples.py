"""A runner before a ring of cameras, as a detector sees him."""

import numpy as np

from data_contracts.conventions import COCO17

FPS = 50.0
MIRRORED = [
    COCO17.index(name.replace("left", "*").replace("right", "left").replace("*", "right"))
    for name in COCO17
]
"""The same joint on the other side."""


SWINGING = np.array([0, 0, 0, 0, 0, 1, 2, 1, 2, 1, 2, 3, 4, 3, 4, 3, 4])
"""Which part of the body a joint swings with: head, arms, legs. Limbs stay as long as they are."""


def runner(frames, persons=2, seed=0):
    """Joints (frames, persons, 17, 3) [m] on circles, limbs swinging at 2 Hz."""
    rng = np.random.default_rng(seed)
    body = rng.uniform([-0.25, -0.25, 0.0], [0.25, 0.25, 1.8], (persons, 17, 3))
    time = np.arange(frames)[:, None] / FPS
    phase = rng.uniform(0, 2 * np.pi, persons)
    radius = np.linspace(2.0, 3.0, persons)
    turn = 1.5 * time + phase
    way = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], axis=-1)
    swing = 0.15 * np.sin(4 * np.pi * time[..., None] + SWINGING)
    return body + way[:, :, None] + swing[..., None] * [1.0, 0.5, 0.2]


def detections(camera, joints, noise=0.0, seed=1):
    """Keypoints with white noise [px], confidence 1 and the index of every person."""
    frames, persons, count, _ = joints.shape
    image = camera.project(joints.reshape(frames, 1, persons * count, 3))
    keypoints = image.reshape(frames, -1, persons, count, 2)
    keypoints = keypoints + noise * np.random.default_rng(seed).normal(size=keypoints.shape)
    confidence = np.ones(keypoints.shape[:-1])
    index = np.broadcast_to(np.arange(persons, dtype=np.int16), confidence.shape[:3]).copy()
    return keypoints, confidence, index
