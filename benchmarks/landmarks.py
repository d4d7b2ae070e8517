"""Compares bodies with and without the landmarks of the shipped net in left-out cameras, on video.

    python benchmarks/landmarks.py TRIAL VIDEOS [--net FILE] [--points WORD ...] [--drawn FILE]

TRIAL is the folder of a Pose2Sim trial of one person with 2D poses in `pose/`, whose boxes the net
takes; VIDEOS has its videos. Joints are those of the bundled pose net in the same boxes. There is
no truth. One camera after the other is left out; the others triangulate the person, and bodies are
fitted with and without landmarks. The table shows distances of the left-out camera's points from
the reprojections, at the person's depth [mm]: medians and 90th percentiles. Bodies are taken where
the detector sees them: offsets of joints and points are added. The last lines are the spread of
lengths over time, for points triangulated by all cameras.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from real_feet import fit, open_trial

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.body import fold_keypoints, load_open_body
from worldpose.body.keypoints import LANDMARKS
from worldpose.body_fitting import BodyFit, perceived_joints, perceived_points
from worldpose.detection import DetectionSettings, load_landmarks
from worldpose.detection.bundled_nets import load_weights
from worldpose.detection.landmark_net import LandmarkEstimator, LandmarkNet
from worldpose.detection.models import load_bundled_pose
from worldpose.geometry import Camera
from worldpose.triangulation import TriangulationSettings, reconstruct_joints
from worldpose.video import open_video

MODEL = load_open_body()
BOX_MARGIN = 0.12
"""Margin of a box around the given keypoints, as a share of the longer side [1]."""
JOINTS = {
    "head": ("nose", "left_ear", "right_ear"),
    "shoulders": ("left_shoulder", "right_shoulder"),
    "elbows": ("left_elbow", "right_elbow"),
    "wrists": ("left_wrist", "right_wrist"),
    "hips": ("left_hip", "right_hip"),
    "knees": ("left_knee", "right_knee"),
    "ankles": ("left_ankle", "right_ankle"),
}
PARTS = ("head", "trunk", "pelvis", "upper_arm", "forearm", "thigh", "shank", "foot", "heel", "toe")


def detect(
    given: KeypointDetections, videos: list[Path], nets: LandmarkEstimator, drawn: Path | None
) -> KeypointDetections:
    """Return joints and landmarks (frames, cameras, 1) in the boxes of the given poses."""
    pose = load_bundled_pose()
    each = []
    for c, path in enumerate(videos):
        rows = []
        with open_video(path) as video:
            for place, number in enumerate(given.frame):
                points = given.keypoints[place, c, 0]
                points = points[np.isfinite(points).all(axis=-1)]
                empty = KeypointDetections.from_keypoints(
                    np.full((1, 17, 2), np.nan), np.full((1, 17), np.nan)
                )
                if len(points) < 8:
                    rows.append(empty.with_points(nets.points))
                    continue
                image = video.frame(int(number))
                low, high = points.min(axis=0), points.max(axis=0)
                margin = BOX_MARGIN * (high - low).max()
                box = np.concatenate([low - margin, high + margin])[None]
                found = pose.estimate(image, box)
                found = nets.add_points(image, found)
                rows.append(found)
                if drawn is not None and place == len(given.frame) // 2:
                    draw(image, found, drawn.with_stem(f"{drawn.stem}_{c}"))
        arrays = {k: np.stack([row.arrays()[k] for row in rows]) for k in rows[0].arrays()}
        each.append(rows[0].with_arrays(arrays, given.frame))
    seen = KeypointDetections.stack(each)
    index = np.where(np.isfinite(seen.confidence).any(axis=(2, 3)), 0, -1)
    return seen.assign_people(index[..., None].astype(np.int16))


def draw(image: np.ndarray, found: KeypointDetections, file: Path) -> None:
    """Write the person with its joints and landmarks."""
    assert found.extra_keypoints is not None
    shown = np.ascontiguousarray(image[..., ::-1])
    for points, color in (
        (found.extra_keypoints[0], (0, 255, 0)),
        (found.keypoints[0], (0, 0, 255)),
    ):
        for x, y in points[np.isfinite(points).all(axis=-1)]:
            cv2.circle(shown, (round(x), round(y)), 5, color, -1)
    x0, y0, x1, y1 = found.boxes[0].astype(int)
    m = (y1 - y0) // 8
    cv2.imwrite(str(file), shown[max(0, y0 - m) : y1 + m, max(0, x0 - m) : x1 + m])


def perceived(bodies: BodyFit, points: tuple[str, ...]) -> Floats:
    """Return joints and points (frames, 17 + points, 3) [m] where the detector sees them."""
    joints = perceived_joints(bodies.joints, bodies.offsets)
    places = fold_keypoints(MODEL, points)(bodies.parameters)
    if bodies.extra is not None:
        own = bodies.extra.points
        where = [points.index(point) for point in own]
        places[:, :, where] += perceived_points(MODEL, own, bodies.parameters, bodies.extra.offsets)
    return np.concatenate([joints, places], axis=2)[:, 0]


def distances(camera: Camera, points: Floats, seen: KeypointDetections, c: int) -> Floats:
    """Return distances of a camera's points from reprojections, at their depth (frames, n) [m]."""
    assert seen.extra_keypoints is not None
    pixels = np.concatenate([seen.keypoints[:, c, 0], seen.extra_keypoints[:, c, 0]], axis=1)
    shown = camera.project(points.reshape(-1, 3)).reshape(pixels.shape)
    away = np.linalg.norm(shown - pixels, axis=-1)
    depth = camera.cam_from_world.apply(points)[..., 2]
    return np.asarray(away * depth / camera.focal.mean())


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trial", type=Path)
    parser.add_argument("videos", type=Path)
    parser.add_argument("--net", type=Path, help="other weights than the shipped ones")
    parser.add_argument("--drawn", type=Path, help="image of the middle frame of each camera")
    asked = parser.parse_args()
    cameras, given, fps = open_trial(asked.trial)
    nets = load_landmarks(DetectionSettings(landmarks=True)) if asked.net is None else None
    nets = nets or LandmarkEstimator(load_weights(asked.net, LandmarkNet()))
    seen = detect(given, sorted(asked.videos.glob("*.mp4")), nets, asked.drawn)
    settings = TriangulationSettings()
    columns = ("triangulated", "bodies without", "bodies with")
    found: dict[str, list[Floats]] = {name: [] for name in columns}
    for c in range(seen.detection_index.shape[1]):
        index = seen.detection_index.copy()
        index[:, c] = -1
        placed = reconstruct_joints(cameras, seen.assign_people(index), fps, settings).triangulation
        assert placed.extra is not None
        points = np.concatenate([placed.joints, placed.extra.joints], axis=2)[:, 0]
        without = perceived(fit(replace(placed, extra=None), fps), seen.points)
        sides = (points, without, perceived(fit(placed, fps), seen.points))
        for name, side in zip(columns, sides, strict=True):
            found[name].append(distances(cameras[c], side, seen, c))
    print("left-out cameras: median and 90 % [mm]")
    groups = {label: [COCO17.index(each) for each in names] for label, names in JOINTS.items()}
    groups["all joints"] = [place for label in groups for place in groups[label]]
    for part in PARTS:
        groups[f"landmarks: {part}"] = [
            17 + k for k, point in enumerate(seen.points) if part in point
        ]
    groups["landmarks: all"] = [17 + k for k, each in enumerate(seen.points) if each in LANDMARKS]
    for label, places in groups.items():
        cells = []
        for name, each in found.items():
            values = 1e3 * np.concatenate([one[:, places].ravel() for one in each])
            values = values[np.isfinite(values)]
            cells.append(f"{name} {np.median(values):6.1f} {np.quantile(values, 0.9):6.1f}")
        print(f"{label:22s} " + " | ".join(cells))
    placed = reconstruct_joints(cameras, seen, fps, settings).triangulation
    assert placed.extra is not None
    print("lengths, standard deviation over time [mm]: triangulated")
    points = np.concatenate([placed.joints, placed.extra.joints], axis=2)[:, 0]
    names = (*COCO17, *seen.points)
    for one, two in (
        ("hip", "knee"),
        ("knee", "ankle"),
        ("shoulder", "elbow"),
        ("elbow", "wrist"),
        ("thigh_1", "thigh_7"),
        ("shank_1", "shank_4"),
        ("upper_arm_1", "upper_arm_3"),
        ("forearm_1", "forearm_2"),
        ("heel", "big_toe"),
    ):
        spread = []
        for side in ("left", "right"):
            a, b = (names.index(f"{side}_{each}") for each in (one, two))
            length = 1e3 * np.linalg.norm(points[:, a] - points[:, b], axis=-1)
            spread.append(f"{np.nanmean(length):6.1f} {np.nanstd(length):5.1f}")
        print(f"{one + ' to ' + two:28s} " + " | ".join(spread))
    bodies = fit(placed, fps)
    assert bodies.extra is not None
    size = 1e3 * np.linalg.norm(bodies.extra.offsets, axis=-1)
    print(f"offsets of the points: median {np.median(size):.1f}, largest {size.max():.1f} mm")


if __name__ == "__main__":
    main()
