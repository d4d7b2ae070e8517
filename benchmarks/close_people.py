"""Clips of people who pass close to each other in a room, seen by few cameras, with ground truth.

For measuring identity switches of tracking. It shares no code with `worldpose.simulation`:
skeleton, motion, cameras and detector errors are its own. The detector makes the errors that swap
identities: it misses a person behind another, merges both into one detection, reports joints of the
person in front, and errs over many frames in the same direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from worldpose.geometry import Camera, Rigid

FPS = 25.0
IMAGE = np.array([1032.0, 776.0])
JOINTS = 17
BONES = [
    *((5, 6), (11, 12), (5, 11), (6, 12)),
    *((5, 7), (7, 9), (6, 8), (8, 10), (11, 13), (13, 15), (12, 14), (14, 16), (0, 5), (0, 6)),
]
"""Pairs of COCO-17 joints between which a body occludes points behind it."""
BODY_RADIUS = 0.13
"""[m]"""


@dataclass(frozen=True)
class Clip:
    """A simulated clip.

    Attributes:
        cameras: batch (cameras,).
        joints: (frames, people, 17, 3) [m], world; NaN while a person is not in the room.
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17); 0 where not found.
        owner: (frames, cameras, detections) person; -1 = none or several.
    """

    cameras: Camera
    joints: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    confidence: NDArray[np.float64]
    owner: NDArray[np.int64]


def simulate_room(seed: int, cameras: int, people: int = 4, seconds: float = 12.0) -> Clip:
    """Return a clip of people who walk, stand and pass each other in a room of 5 x 4 m."""
    rng = np.random.default_rng([seed, 7919])
    frames = round(seconds * FPS)
    half = np.array([2.5, 2.0])
    places = _paths(rng, frames, people, half)
    joints = np.stack([_body(rng, places[:, p]) for p in range(people)], axis=1)
    if people > 2:  # one enters late, one leaves early
        joints[: rng.integers(frames // 3), 0] = np.nan
        joints[frames - rng.integers(frames // 3) :, 1] = np.nan
    rig = _rig(rng, cameras, half)
    keypoints, confidence, owner = _detect(rng, rig, joints)
    return Clip(rig, joints, keypoints, confidence, owner)


def _paths(
    rng: np.random.Generator, frames: int, people: int, half: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return places (frames, people, 2) [m]: walks between goals that several people share."""
    goals = rng.uniform(-half, half, (5, 2))
    place = rng.uniform(-half, half, (people, 2))
    goal, pause = rng.integers(5, size=people), np.zeros(people)
    speed, velocity = rng.uniform(0.8, 1.6, people), np.zeros((people, 2))
    out = np.empty((frames, people, 2))
    for frame in range(frames):
        wanted = goals[goal] + 0.35 * np.stack(
            [np.cos(2.4 * np.arange(people)), np.sin(2.4 * np.arange(people))], axis=-1
        )
        to = wanted - place
        far = np.linalg.norm(to, axis=-1)
        going = (far > 0.2) & (pause <= 0.0)
        target = np.where(going[:, None], to / np.maximum(far, 1e-9)[:, None] * speed[:, None], 0.0)
        apart = place[:, None] - place
        distance = np.linalg.norm(apart, axis=-1)
        np.fill_diagonal(distance, np.inf)
        # Bodies do not pass through each other; people step aside late.
        force = np.clip(0.55 - distance, 0.0, None)[..., None] * apart / distance[..., None]
        velocity += (target - velocity) * 3.0 / FPS
        place = place + velocity / FPS + 0.5 * force.sum(axis=1)
        arrived = (far <= 0.2) & (pause <= 0.0)
        pause = np.where(arrived, rng.exponential(1.0, people), pause - 1.0 / FPS)
        change = arrived | (rng.random(people) < 0.1 / FPS)
        goal = np.where(change, rng.integers(5, size=people), goal)
        speed = np.where(change, rng.uniform(0.6, 1.8, people), speed)
        out[frame] = place
    return out


def _body(rng: np.random.Generator, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return joints (frames, 17, 3) [m] of one person along a path (frames, 2)."""
    frames = len(places)
    time = np.arange(frames) / FPS
    smooth = np.stack([np.convolve(axis, np.ones(9) / 9, "same") for axis in places.T], -1)
    velocity = np.gradient(smooth, 1 / FPS, axis=0)
    speed = np.linalg.norm(velocity, axis=-1)
    heading = np.empty(frames)
    angle = rng.uniform(-np.pi, np.pi)
    for frame in range(frames):
        if speed[frame] > 0.3:
            wanted = np.arctan2(velocity[frame, 1], velocity[frame, 0])
            angle += 0.15 * np.angle(np.exp(1j * (wanted - angle)))
        heading[frame] = angle
    size = rng.normal(1.0, 0.045)
    leg, torso, arm = size * np.array([0.86, 0.52, 0.56]) * rng.normal(1.0, 0.025, 3)
    shoulder, hip = size * np.array([0.17, 0.12]) * rng.normal(1.0, 0.05, 2)
    phase = 2 * np.pi * np.cumsum(0.9 * np.sqrt(speed)) / FPS + rng.uniform(0, 6)
    swing = 0.5 * np.clip(speed / 1.2, 0.0, 1.0) * np.sin(phase)
    bend = 0.35 * np.clip(np.sin(0.7 * time + rng.uniform(0, 6)) - 0.6, 0.0, None)
    reach = np.clip(np.sin(0.9 * time + rng.uniform(0, 6)), 0.0, None)[None] * np.array(
        [[rng.uniform(0, 1.6)], [rng.uniform(0, 1.6)]]
    )
    zero = np.zeros(frames)

    def local(forward: ArrayLike, side: ArrayLike, up: ArrayLike) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(forward, side, up, zero)[:3], axis=-1)

    out = np.empty((frames, JOINTS, 3))
    up = leg + 0.08 * size
    top = up + torso * np.cos(bend)
    lean = torso * np.sin(bend)
    out[:, 0] = local(lean + 0.10, 0, top + 0.20 * size)
    for side, sign in ((0, 1.0), (1, -1.0)):
        out[:, 1 + side] = local(lean + 0.08, 0.03 * sign, top + 0.24 * size)
        out[:, 3 + side] = local(lean, 0.07 * sign, top + 0.22 * size)
        out[:, 5 + side] = local(lean, shoulder * sign, top)
        lift = reach[side] - sign * swing
        elbow = 0.54 * arm
        out[:, 7 + side] = local(
            lean + elbow * np.sin(lift), (shoulder + 0.04) * sign, top - elbow * np.cos(lift)
        )
        fore = lift + 0.3 + 0.6 * reach[side]
        out[:, 9 + side] = out[:, 7 + side] + local(
            0.46 * arm * np.sin(fore), 0.0, -0.46 * arm * np.cos(fore)
        )
        out[:, 11 + side] = local(0, hip * sign, up)
        thigh = sign * swing
        out[:, 13 + side] = local(0.5 * leg * np.sin(thigh), hip * sign, up - 0.5 * leg)
        shin = thigh - 0.4 * np.clip(sign * np.cos(phase), 0, None) * np.clip(speed, 0, 1)
        out[:, 15 + side] = out[:, 13 + side] + local(
            0.5 * leg * np.sin(shin), 0.0, -0.5 * leg * np.cos(shin)
        )
    cosine, sine = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = out[..., 0].copy(), out[..., 1].copy()
    out[..., 0] = cosine * x - sine * y + smooth[:, None, 0]
    out[..., 1] = sine * x + cosine * y + smooth[:, None, 1]
    return out


def _rig(rng: np.random.Generator, count: int, half: NDArray[np.float64]) -> Camera:
    """Return cameras along the walls that look at the middle of the room."""
    first, out = rng.uniform(0, 2 * np.pi), []
    steps = np.sort(rng.uniform(0.6, 1.4, count).cumsum())
    for angle in first + 2 * np.pi * steps / (steps[-1] + rng.uniform(0.6, 1.4)):
        center = np.append((half + 1.8) * [np.cos(angle), np.sin(angle)], rng.uniform(1.5, 3.0))
        forward = np.append(rng.uniform(-0.5, 0.5, 2), 1.0) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        out.append(
            Camera(
                focal=np.full(2, rng.uniform(560, 760)),
                principal_point=0.5 * IMAGE + rng.normal(0, 8, 2),
                distortion=np.zeros(5),
                cam_from_world=Rigid(rotation, -rotation @ center),
                image_size=IMAGE.astype(int),
            )
        )
    return Camera.stack(out)


def _detect(
    rng: np.random.Generator, rig: Camera, joints: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Return a detector's results: keypoints, confidence, and owners."""
    frames, people = joints.shape[:2]
    cameras = len(rig.focal)
    room = people + 2
    keypoints = np.full((frames, cameras, room, JOINTS, 2), np.nan)
    confidence = np.zeros(keypoints.shape[:-1])
    owner = np.full(confidence.shape[:-1], -1)
    shape = (cameras, people, JOINTS)
    slow = rng.normal(0, 0.02, (*shape, 2))  # errors that last, in metres at the person
    bias = rng.normal(0, 0.012, (JOINTS, 2))
    missed = np.zeros((cameras, people), dtype=bool)
    coat = rng.uniform([100, 200], [900, 400], (cameras, 2))  # false positive at a fixed place
    has_coat = rng.random(cameras) < 0.3
    for frame in range(frames):
        slow = 0.9 * slow + np.sqrt(1 - 0.81) * rng.standard_t(5, slow.shape) * 0.02
        missed = np.where(missed, rng.random(missed.shape) < 0.8, rng.random(missed.shape) < 0.01)
        for c in range(cameras):
            camera = rig[np.array([c])]
            points = joints[frame].reshape(1, -1, 3)
            pixels = camera.project(points)[0].reshape(people, JOINTS, 2)
            depth = camera.cam_from_world.apply(points)[0].reshape(people, JOINTS, 3)[..., 2]
            scale = camera.focal[0, 0] / depth.mean(axis=-1)
            seen, front = _occlusion(pixels, depth, scale)
            jitter = (slow[c] + bias + rng.standard_t(4, slow[c].shape) * 0.008) * scale[
                :, None, None
            ]
            found = pixels + jitter + rng.normal(0, 0.8, jitter.shape)
            taken = rng.random((people, JOINTS)) < 0.4  # joints of the person in front
            given = []
            for p in range(people):
                if not np.isfinite(pixels[p]).all() or missed[c, p]:
                    continue
                hidden = ~seen[p]
                share = hidden.mean()
                if share > 0.5 and rng.random() < share:
                    continue
                pose = found[p].copy()
                theirs = hidden & taken[p] & (front[p] >= 0)
                pose[theirs] = found[front[p][theirs], np.flatnonzero(theirs)]
                lost = hidden & ~theirs & (rng.random(JOINTS) < 0.7)
                pose[hidden & ~theirs] += (
                    rng.normal(0, 0.06, (np.sum(hidden & ~theirs), 2)) * scale[p]
                )
                pose[lost | ~((pose > 0) & (pose < IMAGE)).all(-1)] = np.nan
                given.append((pose, p))
            given = _merge_close(rng, given)
            if has_coat[c] and rng.random() < 0.5:
                pose = found[rng.integers(people)]
                given.append((pose - pose.mean(axis=0) + coat[c], -1))
            order = rng.permutation(len(given))[:room]
            for place, n in enumerate(order):
                pose, person = given[n]
                known = np.isfinite(pose[:, 0])
                keypoints[frame, c, place] = pose
                confidence[frame, c, place] = np.where(known, rng.uniform(0.4, 0.9), 0.0)
                owner[frame, c, place] = person
    return keypoints, confidence, owner


def _merge_close(
    rng: np.random.Generator, given: list[tuple[NDArray[np.float64], int]]
) -> list[tuple[NDArray[np.float64], int]]:
    """Return detections after random merges of two with large overlap."""
    out = list(given)
    for a in range(len(given)):
        for b in range(a + 1, len(given)):
            one, two = given[a][0], given[b][0]
            both = np.isfinite(one[:, 0]) & np.isfinite(two[:, 0])
            if both.sum() < 5:
                continue
            height = np.nanmax(one[:, 1]) - np.nanmin(one[:, 1])
            near = np.linalg.norm((one - two)[both], axis=-1).mean() < 0.15 * height
            if near and rng.random() < 0.6:
                out = [each for each in out if each[1] not in (given[a][1], given[b][1])]
                if rng.random() < 0.5:
                    out.append(given[a] if rng.random() < 0.5 else given[b])
                else:  # the upper half of one, the lower half of the other
                    lower = np.arange(JOINTS)[:, None] >= 11
                    out.append((np.where(lower, one, two), -1))
    return out


def _occlusion(
    pixels: NDArray[np.float64], depth: NDArray[np.float64], scale: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return visible joints (people, 17), and the person in front of the others, -1 = none."""
    people = len(pixels)
    front = np.full((people, JOINTS), -1)
    middle = depth.mean(axis=-1)
    for p in range(people):
        for other in range(people):
            if not middle[other] < middle[p] - 0.15:  # also where either is absent
                continue
            for a, b in BONES:
                start, along = pixels[other, a], pixels[other, b] - pixels[other, a]
                share = ((pixels[p] - start) @ along) / max(float(along @ along), 1e-9)
                nearest = start + np.clip(share, 0, 1)[:, None] * along
                covered = np.linalg.norm(pixels[p] - nearest, axis=-1) < BODY_RADIUS * scale[other]
                front[p, covered] = other
    return front < 0, front
