"""Scores the landmarks of the shipped net on real stills and on two cameras of a real match.

    python benchmarks/real_landmarks.py stills DATA [--net FILE] [--drawn FILE.png]
    python benchmarks/real_landmarks.py pair DATA [--net FILE] [--frames 30] [--drawn FILE.png]

No real image has labelled landmarks.

stills: twelve stills of football matches with joints labelled by eye (see stills.py). A joint
follows from the landmarks of its neighbouring segments, by weights that are fitted to the body
model in simulated poses (errors of joints from true landmarks come first). So landmarks are
compared with labels, as are the joints of the bundled pose net in the same boxes.

pair: two cameras 0.46 m apart (see tests/real/static_pair.py). Both show a person from one side, so
that a similarity transform maps one image of a person to the other. It is fitted to all joints and
all landmarks but those of one segment (left out in turn); the distance of the landmarks left out
is given in percent of the person's height, and that of joints, too. Lengths between landmarks of
one segment are compared between both cameras.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from data_contracts.arrays import AnyFloats, Floats, Image
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.detection.bundled_nets import load_weights
from worldpose.detection.interfaces import People
from worldpose.detection.landmark_net import POINTS, LandmarkEstimator, LandmarkNet, Landmarks
from worldpose.detection.models import load_bundled_detector, load_bundled_pose, load_landmarks
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import combine_boxes
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.training.labels import PictureCache, read_labels
from worldpose.training.metrics import TORSO_SHARE, torso_sizes
from worldpose.video.folder import open_video

MODEL = load_open_body()
NEAREST = 12
"""Landmarks from which a joint follows."""
RIDGE_M = 0.05
"""Weight of equal shares against the fit to bodies [m]: small shares pass on little noise."""
LABELLED = COCO17[5:]
"""Joints that the stills have labels of: all but those of the head."""
LATE = {"left": 4, "right": 0}
"""Offset of each camera's frames."""


def joint_shares() -> Floats:
    """Return the shares of landmarks in joints (12, points), from bodies in simulated poses."""
    scenario = SCENARIOS["match"].model_copy(update={"duration": 4.0, "broadcast": None})
    poses = simulate_scene(scenario, 77).poses[:, ::20]
    rest = BodyParameters(np.zeros(MODEL.shapes), np.zeros(3), np.zeros(BODY_POSE), np.zeros(3))
    points, joints = (fold_keypoints(MODEL, names) for names in (POINTS, LABELLED))
    apart = np.linalg.norm(joints(rest)[:, None] - points(rest), axis=-1)
    places, aims = points(poses).reshape(-1, len(POINTS), 3), joints(poses).reshape(-1, 12, 3)
    shares = np.zeros((len(LABELLED), len(POINTS)))
    for joint in range(len(LABELLED)):
        near = np.argsort(apart[joint])[:NEAREST]
        # Shares have the sum 1: the last one follows from the others.
        base = places[:, near[-1]]
        columns = np.moveaxis(places[:, near[:-1]] - base[:, None], 1, 2).reshape(-1, NEAREST - 1)
        aim = (aims[:, joint] - base).ravel()
        weight = RIDGE_M**2 * len(columns)
        equal = np.full(NEAREST - 1, 1.0 / NEAREST)
        found = np.linalg.solve(
            columns.T @ columns + weight * np.eye(NEAREST - 1), columns.T @ aim + weight * equal
        )
        shares[joint, near[:-1]] = found
        shares[joint, near[-1]] = 1.0 - found.sum()
        off = np.linalg.norm(np.einsum("k,nka->na", shares[joint], places) - aims[:, joint], axis=1)
        print(
            f"{LABELLED[joint]:16s} from true landmarks: {1e3 * np.median(off):5.1f} mm, noise "
            f"times {np.linalg.norm(shares[joint]):.2f}"
        )
    return shares


def score_stills(data: Path, nets: LandmarkEstimator, drawn: Path | None) -> None:
    """Print errors of joints that follow from landmarks, and of the pose net's joints."""
    shares = joint_shares()
    pose, cache = load_bundled_pose(), PictureCache(1 << 28)
    each: dict[str, list[Floats]] = {"landmarks": [], "pose net": []}
    tiles: list[Image] = []
    for still in read_labels(data / "stills" / "labels.json"):
        asked = (still.visible > 0).any(axis=1)
        if not asked.any():
            continue
        image, true = cache[still.path], still.keypoints[asked]
        joints = pose.estimate(image, still.boxes[asked])
        found = nets.estimate(image, np.asarray(joints.boxes, dtype=np.float64))
        derived = np.full(true.shape, np.nan)
        derived[:, 5:] = np.einsum("jk,pka->pja", shares, found.places)
        torso = torso_sizes(true)[:, None]
        shown = (still.visible[asked] == 2) & (np.arange(17) >= 5)
        for name, places in (("landmarks", derived), ("pose net", joints.keypoints)):
            off = np.linalg.norm(places - true, axis=-1) / torso
            each[name].append(np.where(shown, off, np.nan))
        tiles += [
            draw(image, box, one) for box, one in zip(joints.boxes, people(found), strict=True)
        ]
    print(f"{'':12s}" + "".join(f"{name:>22s}" for name in each))
    for label, columns in (
        ("shoulders", (5, 6)), ("elbows", (7, 8)), ("wrists", (9, 10)),
        ("hips", (11, 12)), ("knees", (13, 14)), ("ankles", (15, 16)), ("all", range(5, 17)),
    ):  # fmt: skip
        cells = []
        for rows in each.values():
            off = np.concatenate(rows)[:, list(columns)]
            off = off[np.isfinite(off)]
            cells.append(f"{(off <= TORSO_SHARE).mean():8.3f} {np.median(off):6.3f} {len(off):6d}")
        print(f"{label:12s}" + "".join(f"{cell:>22s}" for cell in cells))
    print("PCK at 0.2 torsos, median error [torsos], joints")
    write_tiles(tiles, drawn)


def people(found: Landmarks) -> list[Landmarks]:
    """Return the landmarks of each person."""
    return [
        Landmarks(found.places[k], found.std[k], found.visible[k]) for k in range(len(found.places))
    ]


def draw(image: Image, box: Floats, found: Landmarks, size: int = 240) -> Image:
    """Return the person enlarged, visible landmarks green and others red."""
    scale = size / (1.3 * float(np.max(box[2:] - box[:2])))
    middle = 0.5 * (box[:2] + box[2:])
    mapping = np.column_stack([scale * np.eye(2), 0.5 * size - scale * middle])
    tile = np.asarray(cv2.warpAffine(image, mapping, (size, size)), dtype=np.uint8)
    for place, visible in zip(found.places, found.visible, strict=True):
        x, y = np.round(mapping[:, :2] @ place + mapping[:, 2]).astype(int)
        cv2.circle(tile, (int(x), int(y)), 2, (0, 255, 0) if visible >= 0.5 else (255, 0, 0), -1)
    return tile


def write_tiles(tiles: Sequence[Image], file: Path | None, columns: int = 6) -> None:
    """Write up to four rows of tiles, evenly spaced among all."""
    if file is None or not tiles:
        return
    chosen = [tiles[k] for k in np.linspace(0, len(tiles) - 1, 4 * columns).round().astype(int)]
    rows = [np.hstack(chosen[k : k + columns]) for k in range(0, len(chosen), columns)]
    cv2.imwrite(str(file), np.vstack(rows)[..., ::-1])


def find_people(image: Image, nets: LandmarkEstimator) -> tuple[KeypointDetections, Landmarks]:
    """Return certain people of a frame with joints, and their landmarks."""
    settings = DetectionSettings()
    (seen,) = load_bundled_detector().detect([image])
    sure = seen.scores >= settings.high_score_threshold
    seen = People(seen.boxes[sure], seen.scores[sure])
    poses = combine_boxes(seen, load_bundled_pose().estimate(image, seen.boxes))
    return poses, nets.estimate(image, np.asarray(poses.boxes, dtype=np.float64))


def similarity(start: AnyFloats, end: AnyFloats) -> Floats:
    """Return the similarity (2, 3) that maps points (n, 2) best to others."""
    a, b = start - start.mean(axis=0), end - end.mean(axis=0)
    square = float((a**2).sum())
    cos = float((a * b).sum()) / square
    sin = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / square
    linear = np.array([[cos, -sin], [sin, cos]])
    return np.column_stack([linear, end.mean(axis=0) - linear @ start.mean(axis=0)])


def compare_pair(data: Path, nets: LandmarkEstimator, frames: int, drawn: Path | None) -> None:
    """Print differences between the landmarks of two cameras."""
    parts = ("head", "trunk", "pelvis", "upper_arm", "forearm", "thigh", "shank", "foot")
    member = {part: [k for k, name in enumerate(POINTS) if part in name] for part in parts}
    off: dict[str, list[float]] = {name: [] for name in ("joints", *parts)}
    ratios: dict[str, list[float]] = {"thigh_1 to thigh_7": [], "hip to knee": []}
    tiles: list[Image] = []
    videos = {
        side: open_video(data / "static_pair" / f"{side}_camera.mp4") for side in ("left", "right")
    }
    with videos["left"], videos["right"]:
        for number in np.linspace(0, 140, frames).round().astype(int):
            found = []
            for side, video in videos.items():
                image = video.frame(int(number) + LATE[side])
                found.append((image, *find_people(image, nets)))
            for one, two in match_people(found[0][1], found[1][1]):
                sides = [
                    (each[1].keypoints[k], each[2].places[k])
                    for each, k in ((found[0], one), (found[1], two))
                ]
                height = float(np.ptp(found[1][1].boxes[two][[1, 3]]))
                compare_views(sides, height, member, off, ratios)
                tiles.append(draw(found[0][0], found[0][1].boxes[one], people(found[0][2])[one]))
    print(f"{len(off['joints'])} pairs of images of a person")
    for name, values in off.items():
        print(f"{name:10s} median {100 * np.median(values):5.2f} % of the height, 90 % "
              f"{100 * np.quantile(values, 0.9):5.2f}")  # fmt: skip
    for name, values in ratios.items():
        print(f"{name:20s} difference of lengths, median {100 * np.median(values):5.1f} %")
    write_tiles(tiles, drawn)


def compare_views(
    sides: Sequence[tuple[Floats, Floats]],
    height: float,
    member: dict[str, list[int]],
    off: dict[str, list[float]],
    ratios: dict[str, list[float]],
) -> None:
    """Add the differences of one person's images.

    Args:
        sides: joints (17, 2) and landmarks (points, 2) of both images [px].
        height: of the person in the second image [px].
        member: landmarks of each segment.
        off: distances of points left out by group, shares of the height; extended.
        ratios: relative differences of lengths; extended.
    """
    first, second = (np.concatenate(side) for side in sides)

    def left_out(places: Sequence[int]) -> float:
        kept = np.setdiff1d(np.arange(len(first)), places)
        mapping = similarity(first[kept], second[kept])
        moved = first[list(places)] @ mapping[:, :2].T + mapping[:, 2]
        return float(np.median(np.linalg.norm(moved - second[list(places)], axis=1))) / height

    off["joints"].append(left_out(range(5, 17)))
    for part, places in member.items():
        off[part].append(left_out([17 + k for k in places]))
    scale = float(np.linalg.norm(similarity(first, second)[:, 0]))
    for name, pairs in (
        ("thigh_1 to thigh_7", [(f"{s}_thigh_1", f"{s}_thigh_7") for s in ("left", "right")]),
        ("hip to knee", [(f"{s}_hip", f"{s}_knee") for s in ("left", "right")]),
    ):
        names = (*COCO17, *POINTS)
        for a, b in pairs:
            one, two = (
                float(np.linalg.norm(side[names.index(a)] - side[names.index(b)]))
                for side in (scale * first, second)
            )
            ratios[name].append(2.0 * abs(one - two) / (one + two))


def match_people(left: KeypointDetections, right: KeypointDetections) -> list[tuple[int, int]]:
    """Return detections of the same people in both cameras.

    Poses that fit each other best after a similarity are candidates. The similarity of all
    candidates' boxes, by RANSAC, keeps those that lie in one place of the pitch.
    """
    size = (len(left.score), len(right.score))
    fit = np.full(size, np.inf)
    for one, two in np.ndindex(*size):
        first, second = left.keypoints[one][5:], right.keypoints[two][5:]
        mapping = similarity(first, second)
        moved = first @ mapping[:, :2].T + mapping[:, 2]
        height = np.ptp(right.boxes[two][[1, 3]])
        fit[one, two] = np.median(np.linalg.norm(moved - second, axis=1)) / height
    pairs = [
        (one, int(fit[one].argmin()))
        for one in range(size[0])
        if size[1] and fit[:, fit[one].argmin()].argmin() == one
    ]
    if len(pairs) < 5:
        return []
    feet = [
        np.array([[each.boxes[k][[0, 2]].mean(), each.boxes[k][3]] for k in chosen])
        for each, chosen in zip((left, right), zip(*pairs, strict=True), strict=True)
    ]
    _, kept = cv2.findHomography(feet[0], feet[1], cv2.RANSAC, 25.0)
    if kept is None or kept.sum() < 5:
        return []
    return [pair for pair, good in zip(pairs, kept[:, 0], strict=True) if good]


def main() -> None:
    """Print the tables of one data set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("stills", "pair"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--net", type=Path, help="weights; the shipped ones in integers if absent")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--drawn", type=Path)
    asked = parser.parse_args()
    nets = None if asked.net else load_landmarks(DetectionSettings(landmarks=True))
    nets = nets or LandmarkEstimator(load_weights(asked.net, LandmarkNet()))
    if asked.what == "stills":
        score_stills(asked.data, nets, asked.drawn)
    else:
        compare_pair(asked.data, nets, asked.frames, asked.drawn)


if __name__ == "__main__":
    main()
