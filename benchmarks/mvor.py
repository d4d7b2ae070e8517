"""Error and coverage on MVOR: real detections of an operating room from three cameras."""

from __future__ import annotations

import json
from argparse import Namespace
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from common import read_changes
from registry import DATA, SET, Table, Tables, benchmark
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import reconstruct_joints
from worldpose.triangulation.settings import TriangulationSettings

PUBLISHED = {3: 9.9, 2: 18.3}
"""mv3dreg's mean error by views [cm]."""

GROUPS = {"shoulder": (5, 6), "hip": (11, 12), "elbow": (7, 8), "wrist": (9, 10)}

COCO = [5, 6, 11, 12, 7, 8, 9, 10]

MVOR = [2, 3, 4, 5, 6, 7, 8, 9]
"""Left and right shoulder, hip, elbow, wrist."""

SEEN_M, FOUND_M = 0.25, 0.5

NO_BOX, NO_IDENTITY = -2, -1
"""Identities of detections outside of all boxes, and in a box whose person was not recognised."""

VERDICTS = ("real", "false", "unknown")

INSIDE, BORDER = 0.6, 0.1
"""Share of a detection's joints in its box, and border that is added, of the box's size [1]."""


@benchmark("mvor", "an operating room from two and three cameras (MVOR)", DATA, SET)
def score_room(options: Namespace) -> Tables:
    """DATA holds `mvor` with camma_mvor_2018.json and openpose_kps.json of CAMMA-public/MVOR.

    Every annotated moment is a clip of one frame, in metres and without a pitch. A person counts as
    seen by a camera when one of its detections is within 0.25 m of the annotated upper-body joints
    on average, measured at their depth, each detection used once. A person is found if a result is
    within 0.5 m, by the mean over shoulders, hips, elbows and wrists. Annotated hips are some 17 cm
    from COCO's. Published errors are of mv3dreg, which selects people differently.

    Not all people are annotated in 3D, but each has a box in every image, most with an identity. A
    result beyond the people in 3D is a person if two of its detections have one identity, or if one
    has it and the other lies in a box without identity, in a view where this person has no other
    box. It cannot be judged if all its boxes lack an identity. All others are false.
    """
    settings = TrackingSettings.model_validate(read_changes(options.settings))
    result, rows = measure(*load_moments(options.data / "mvor"), settings), []
    for views, published in PUBLISHED.items():
        groups = mean_error(result["errors"][views])
        counts = [result[name][views] for name in ("results", "extra", "false", "unknown")]
        found = [len(result["errors"][views]), result["people"][views], groups.mean(), published]
        rows.append([views, *found, *groups, *counts])
    columns = [
        "views",
        "found",
        "of",
        "error [cm]",
        "published [cm]",
        *(f"{g} [cm]" for g in GROUPS),
    ]
    columns += ["results", "beyond the annotated", "false", "unknown"]
    return {"room": Table(f"{result['moments']} moments", columns, rows)}


def load_cameras(info: dict[str, Any]) -> Camera:
    """Return the three cameras in the room's frame [m]."""
    given = info["camParams"]
    room_from_first = np.array(given["firstCamToRoomRef"]).reshape(4, 4)
    cameras = []
    for lens, extrinsic in zip(given["intrinsics"], given["extrinsics"], strict=True):
        # The extrinsics map points of each camera into the first one's frame.
        camera_from_room = np.linalg.inv(room_from_first @ np.array(extrinsic).reshape(4, 4))
        cameras.append(
            Camera(
                focal=np.array(lens["focallength"]),
                principal_point=np.array(lens["principalpoint"]),
                # Keypoints are in the original images, with lens distortion.
                distortion=np.zeros(5),
                cam_from_world=Rigid(camera_from_room[:3, :3], camera_from_room[:3, 3] / 1000.0),
                image_size=np.array(lens["imagesize"]),
            )
        )
    return Camera.stack(cameras)


def load_moments(folder: Path) -> tuple[Camera, list[dict[str, Any]]]:
    """Return cameras, and for each annotated moment truth, detections and boxes.

    `truth` (people, 8, 3) [m], `image` (1, 3, most, 17, 3) [px], and `boxes` by view: (boxes, 5)
    left, top, width, height [px] and identity.
    """
    said = json.loads((folder / "camma_mvor_2018.json").read_text())
    room = np.array(said["cameras_info"]["camParams"]["firstCamToRoomRef"]).reshape(4, 4)
    detections: dict[int, list[Floats]] = defaultdict(list)
    for each in json.loads((folder / "openpose_kps.json").read_text()):
        detections[each["image_id"]].append(np.array(each["coco_keypoints"]).reshape(17, 3))
    boxes: dict[int, list[list[float]]] = defaultdict(list)
    for each in said.get("annotations", []):
        boxes[each["image_id"]].append([*each["bbox"], each["person_id"]])
    truth: dict[str, list[Floats]] = defaultdict(list)
    for person in said["annotations3D"]:
        points = np.array(person["keypoints3D"]).reshape(-1, 4)[MVOR]
        joints = (points[:, :3] @ room[:3, :3].T + room[:3, 3]) / 1000.0
        truth[person["image_ids"]].append(np.where(points[:, 3:] > 0, joints, np.nan))
    moments = []
    for ids, people in sorted(truth.items()):
        views = [detections[int(image)] for image in ids.split("_")]
        most = max(1, *map(len, views))
        image = np.full((1, len(views), most, 17, 3), np.nan)
        for camera, found in enumerate(views):
            image[0, camera, : len(found)] = np.array(found).reshape(-1, 17, 3)
        image[~(image[..., 2] > 0.0)] = np.nan
        shown = [np.array(boxes[int(name)]).reshape(-1, 5) for name in ids.split("_")]
        moments.append({"truth": np.array(people), "image": image, "boxes": shown})
    return load_cameras(said["cameras_info"]), moments


def count_views(cameras: Camera, truth: Floats, image: Floats) -> Integers:
    """Return the number of cameras that see each person (people, 8, 3)."""
    views = np.zeros(len(truth), dtype=np.int64)
    for c in range(image.shape[1]):
        camera = cameras[np.array([c])]
        pixels = camera.project(truth.reshape(1, -1, 3))[0].reshape(len(truth), 8, 2)
        inside = camera.cam_from_world.apply(truth.reshape(1, -1, 3))[0]
        depth = np.nanmean(inside.reshape(len(truth), 8, 3)[..., 2], axis=1)
        off = np.linalg.norm(pixels[:, None] - image[0, c][None, :, COCO, :2], axis=-1)
        known = np.isfinite(off)
        mean = np.where(known, off, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        metres = mean * depth[:, None] / camera.focal[0, 0]
        metres = np.where((known.sum(axis=-1) >= 3) & np.isfinite(metres), metres, 9.0)
        rows, columns = linear_sum_assignment(metres)
        views[rows[metres[rows, columns] <= SEEN_M]] += 1
    return views


def name_detections(boxes: Floats, image: Floats) -> list[int]:
    """Return the identity of each detection (detections, 17, 3) of a view from boxes (n, 5)."""
    names = []
    for joints in image:
        points = joints[np.isfinite(joints[:, 0]), :2]
        if not (len(points) and len(boxes)):
            names.append(NO_BOX)
            continue
        corner, size = boxes[:, None, :2], boxes[:, None, 2:4]
        near = (points > corner - BORDER * size) & (points < corner + (1.0 + BORDER) * size)
        inside = near.all(axis=-1).mean(axis=1)
        low, high = points.min(axis=0), points.max(axis=0)
        common = np.minimum(high, boxes[:, :2] + boxes[:, 2:4]) - np.maximum(low, boxes[:, :2])
        both = np.clip(common, 0.0, None).prod(axis=1)
        union = (high - low).prod() + boxes[:, 2:4].prod(axis=1) - both
        fit = np.where(inside >= INSIDE, inside + both / np.maximum(union, 1e-9), 0.0)
        best = int(fit.argmax())
        names.append(int(boxes[best, 4]) if fit[best] > 0.0 else NO_BOX)
    return names


def judge_result(
    names: list[int], elsewhere: list[set[int]], taken: set[int]
) -> tuple[str, int | None]:
    """Return whether a result is "real", "false" or "unknown", and the identity of its person.

    `names` are identities of its detections, `elsewhere` those of all boxes in their views, `taken`
    those of people that other results show.
    """
    known = Counter(name for name in names if name >= 0)
    if not known:
        return ("unknown" if names.count(NO_IDENTITY) >= 2 else "false"), None
    person, count = known.most_common(1)[0]
    if count == 1:
        alone = len(known) == 1
        agrees = [
            name == NO_IDENTITY and person not in seen
            for name, seen in zip(names, elsewhere, strict=True)
        ]
        if not (alone and any(agrees)):
            return "false", None
    return ("false" if person in taken else "real"), person


def measure(
    cameras: Camera, moments: list[dict[str, Any]], settings: TrackingSettings
) -> dict[str, Any]:
    """Return errors (people, 8) [cm] of found people by views, and counts.

    `people` counts annotated people by the cameras that see them, `results` all placed people and
    `extra` those beyond the annotated ones, both by the cameras whose detections place them. Of
    `extra`, `false` are no person and `unknown` cannot be judged.
    """
    errors: dict[int, list[Floats]] = defaultdict(list)
    people: dict[int, int] = defaultdict(int)
    results: dict[int, int] = defaultdict(int)
    extra: dict[int, int] = defaultdict(int)
    judged: dict[str, dict[int, int]] = {name: defaultdict(int) for name in VERDICTS}
    for moment in moments:
        truth, image = moment["truth"], moment["image"]
        views = count_views(cameras, truth, image)
        seen = KeypointDetections.from_keypoints(image[..., :2], image[..., 2])
        tracks = track_people(cameras, seen, 25.0, settings)
        found = np.empty((0, 8, 3))
        used = (tracks.detection_index[0] >= 0).sum(axis=0)
        if len(tracks.person):
            detections = seen.assign_people(tracks.detection_index)
            placed = reconstruct_joints(cameras, detections, 25.0, TriangulationSettings())
            found = placed.triangulation.joints[0][:, COCO].astype(np.float64)
        off = np.linalg.norm(truth[:, None] - found, axis=-1)
        known = np.isfinite(off)
        mean = np.where(known, off, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        mean = np.where(known.any(axis=-1), mean, 9.0)
        rows, columns = linear_sum_assignment(mean)
        good = mean[rows, columns] <= FOUND_M
        for count in views.tolist():
            people[count] += 1
        for row, column in zip(rows[good], columns[good], strict=True):
            errors[int(views[row])].append(100.0 * off[row, column])
        for count in used.tolist():
            results[count] += 1
        named = [name_detections(*view) for view in zip(moment["boxes"], image[0], strict=True)]
        identities = [set(boxes[:, 4].astype(int).tolist()) for boxes in moment["boxes"]]
        taken: set[int] = set()
        matched = columns[good].tolist()
        others = set(range(len(found))) - set(matched)
        for row in [*matched, *sorted(others, key=lambda row: -int(used[row]))]:
            views_of = np.flatnonzero(tracks.detection_index[0, :, row] >= 0).tolist()
            names = [named[c][tracks.detection_index[0, c, row]] for c in views_of]
            verdict, person = judge_result(names, [identities[c] for c in views_of], taken)
            if person is not None:
                taken.add(person)
            if row in others:
                extra[int(used[row])] += 1
                judged[verdict][int(used[row])] += 1
    return {
        "errors": errors,
        "people": people,
        "results": results,
        "extra": extra,
        "false": judged["false"],
        "unknown": judged["unknown"],
        "moments": len(moments),
    }


def mean_error(errors: list[Floats]) -> Floats:
    """Return the mean error of each of `GROUPS` (4,) [cm]; NaN without people."""
    if not errors:
        return np.full(len(GROUPS), np.nan)
    means: Floats = np.nanmean(np.array(errors).reshape(-1, len(GROUPS), 2), axis=(0, 2))
    return means
