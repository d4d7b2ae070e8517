"""A small match of its own making: stick people who walk, cameras, clicks, and the folder of it.

Nothing here comes from the project's simulator: people are sticks, the pitch's points are written
down from the Laws of the Game, and OpenCV projects. A case mutates a `Draft` and writes it.
"""

import io
import json
import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import yaml

FPS, FRAMES, COCO_JOINTS = 25.0, 10, 17


@dataclass
class Camera:
    """A camera as it films: OpenCV's model, x_cam = R x_world + t, lengths in metres and pixels."""

    width: int
    height: int
    focal: tuple
    principal: tuple
    distortion: tuple
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def center(self):
        return -self.rotation.T @ self.translation

    @property
    def matrix(self):
        (fx, fy), (cx, cy) = self.focal, self.principal
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def pixels(self, points):
        """Pixels (..., 2) of world points (..., 3); NaN behind the camera and outside the image."""
        flat = np.reshape(np.asarray(points, dtype=float), (-1, 3))
        seen_from_here = flat @ self.rotation.T + self.translation
        pose = cv2.Rodrigues(self.rotation)[0], self.translation
        found = cv2.projectPoints(flat[:, None], *pose, self.matrix, np.array(self.distortion))[0]
        found = found[:, 0]
        # Beyond the field of view a polynomial lens folds points back into the image.
        depth = seen_from_here[:, 2]
        plain = seen_from_here[:, :2] / depth[:, None]
        edge = np.array([self.width, self.height]) / (2.0 * np.array(self.focal))
        seen = (depth > 0.5) & (np.abs(plain) < 1.5 * edge + 0.2).all(axis=1)
        seen &= (found >= 0).all(axis=1) & (found < [self.width, self.height]).all(axis=1)
        found[~seen] = np.nan
        return found.reshape(*np.shape(points)[:-1], 2)

    def looking(self, center, target, roll=0.0):
        """The same camera at another place."""
        forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        turn = cv2.Rodrigues(np.array([0.0, 0.0, -roll]))[0]
        rotation = turn @ np.array([right, np.cross(forward, right), forward])
        return replace(self, rotation=rotation, translation=-rotation @ np.asarray(center, float))


def law_points(length=105.0, width=68.0, crown=0.2):
    """Named points of a pitch (x, y, z) [m], as the Laws of the Game lay them out."""
    flat = {"center_mark": (0.0, 0.0)}
    for end, up in (("near", -1), ("far", 1)):
        flat[f"halfway_{end}"] = (0.0, up * width / 2)
        flat[f"center_circle_{end}"] = (0.0, up * 9.15)
        for side, out in (("left", -1), ("right", 1)):
            goal = out * length / 2
            flat[f"corner_{side}_{end}"] = (goal, up * width / 2)
            flat[f"penalty_area_{side}_{end}_back"] = (goal, up * 20.16)
            flat[f"penalty_area_{side}_{end}_front"] = (goal - out * 16.5, up * 20.16)
            flat[f"goal_area_{side}_{end}_back"] = (goal, up * 9.16)
            flat[f"goal_area_{side}_{end}_front"] = (goal - out * 5.5, up * 9.16)
            across = math.sqrt(9.15**2 - 5.5**2)
            flat[f"penalty_arc_{side}_{end}"] = (goal - out * 16.5, up * across)
            flat[f"penalty_mark_{side}"] = (goal - out * 11.0, 0.0)
    return {name: (x, y, -crown * (2 * y / width) ** 2) for name, (x, y) in flat.items()}


LINES = {
    "touch_line_near": ("corner_left_near", "corner_right_near"),
    "touch_line_far": ("corner_left_far", "corner_right_far"),
    "goal_line_left": ("corner_left_near", "corner_left_far"),
    "goal_line_right": ("corner_right_near", "corner_right_far"),
    "halfway_line": ("halfway_near", "halfway_far"),
}
HEAD = [(0.11, 0.0, 1.60), (0.09, 0.03, 1.64), (0.09, -0.03, 1.64)]
HEAD += [(0.0, 0.075, 1.62), (0.0, -0.075, 1.62)]


def walking(start, heading, height, seconds, phase):
    """COCO-17 joints (frames, 17, 3) [m] of sticks that walk at 1.4 m/s, above z = 0."""
    t = np.asarray(seconds, dtype=float)
    axes = np.array([[math.cos(heading), math.sin(heading), 0.0], [0.0] * 3, [0.0, 0.0, 1.0]])
    axes[1] = np.cross(axes[2], axes[0])
    root = np.array([*start, 0.0]) + 1.4 * t[:, None] * axes[0]

    def at(*place):  # forward, to the left, up
        parts = np.stack(np.broadcast_arrays(*place, t)[:3], axis=-1)
        return root + height / 1.75 * parts @ axes

    joints = np.zeros((len(t), COCO_JOINTS, 3))
    for joint, place in enumerate(HEAD):
        joints[:, joint] = at(*place)
    swing = 0.45 * np.sin(2 * math.pi * 0.95 * t + phase)
    for side, sign in ((0, 1.0), (1, -1.0)):
        arm, leg = -sign * swing, sign * swing
        elbow = (0.29 * np.sin(arm), 1.43 - 0.29 * np.cos(arm))
        wrist = (elbow[0] + 0.25 * np.sin(arm + 0.3), elbow[1] - 0.25 * np.cos(arm + 0.3))
        knee = (0.43 * np.sin(leg), 0.94 - 0.43 * np.cos(leg))
        bend = leg - np.clip(0.5 - leg, 0.0, 0.6)
        ankle = (knee[0] + 0.41 * np.sin(bend), knee[1] - 0.41 * np.cos(bend))
        chain = [((0.0, 1.43), 0.19), (elbow, 0.22), (wrist, 0.22)]
        chain += [((0.0, 0.94), 0.12), (knee, 0.11), (ankle, 0.11)]
        for joint, ((ahead, up), out) in zip(range(5, 17, 2), chain, strict=True):
            joints[:, joint + side] = at(ahead, sign * out, up)
    return joints


@dataclass
class Draft:
    """A match before it is written; kinds change it.

    Attributes:
        cameras: as they film, by id.
        people: truth (frames, people, 17, 3) [m], world.
        spec: content of match.yaml.
        given: tables of calibration.toml by camera; None where cameras are clicked.
        clicks: content of each camera's annotations.
        seen: arrays of each camera's detections.
        pitch: content of pitch.json, if any.
        coco: write detections as COCO results.
        truth: the people again where a kind moves the world; None where no truth is known.
        after: functions of the written folder that spoil its files.
    """

    cameras: dict
    people: np.ndarray
    spec: dict
    given: dict | None = None
    clicks: dict = field(default_factory=dict)
    seen: dict = field(default_factory=dict)
    pitch: dict | None = None
    coco: bool = False
    truth: np.ndarray | None = None
    after: list = field(default_factory=list)
    click_noise: float = 0.6
    pixel_noise: float = 1.0

    def camera_spec(self, name):
        return next(each for each in self.spec["cameras"] if each.get("id") == name)


def new_draft(rng, is_clicked):
    """A good match: four cameras around a penalty area or the centre, three people."""
    middle = np.array([rng.choice([-40.0, 0.0, 40.0]), rng.uniform(-6, 6), 0.9])
    cameras, turn = {}, rng.uniform(0, 2 * math.pi)
    for n in range(4):
        angle = turn + n * math.pi / 2 + rng.uniform(-0.3, 0.3)
        out = rng.uniform(24, 34)
        place = middle + [out * math.cos(angle), out * math.sin(angle), rng.uniform(9, 15)]
        focal, lens = rng.uniform(900, 1200), (-0.05, 0.01, 0.0, 0.0, 0.0)
        plain = (1920, 1080, (focal, focal), (959.5, 539.5), lens, np.eye(3), np.zeros(3))
        aim = middle + [*rng.uniform(-2, 2, 2), 0.0]
        cameras[f"cam{n}"] = Camera(*plain).looking(place, aim)
    people = []
    for angle in turn + np.arange(3) * 2.1:
        start = middle[:2] + [3.0 * math.cos(angle), 3.0 * math.sin(angle)]
        own = rng.uniform([0.0, 1.65, 0.0], [6.28, 1.95, 6.28])
        people.append(walking(start, own[0], own[1], np.arange(FRAMES) / FPS, own[2]))
    people = np.stack(people, axis=1)
    people[..., 2] -= 0.2 * (people[..., 1] / 34.0) ** 2  # they stand on the crown
    sizes = [{"id": n, "width": c.width, "height": c.height} for n, c in cameras.items()]
    spec = {"contract": 1, "match_id": "fuzz", "fps": FPS, "cameras": sizes}
    spec["clips"] = [{"id": "clip", "first_frame": 0, "frame_count": FRAMES}]
    draft = Draft(cameras, people, spec, truth=people)
    if not is_clicked:
        draft.spec["pitch"], draft.given = "none", {}
    return draft


def film(draft, rng):
    """Fill in clicks or given cameras, and detections, from what the cameras see."""
    for number, (name, camera) in enumerate(draft.cameras.items()):
        draft.camera_spec(name).update(width=camera.width, height=camera.height)
        draft.seen[name] = detections_of(draft, camera, rng)
        if draft.given is not None:
            draft.given[f"table{number}"] = {
                "name": name,
                "size": [camera.width, camera.height],
                "matrix": camera.matrix.tolist(),
                "distortions": list(camera.distortion),
                "rotation": cv2.Rodrigues(camera.rotation)[0].ravel().tolist(),
                "translation": camera.translation.tolist(),
            }
            continue
        names, places = zip(*law_points().items(), strict=True)
        pixels = camera.pixels(places)
        found = pixels + rng.normal(0, draft.click_noise, pixels.shape)
        inside = ((found > 2) & (found < [camera.width - 2, camera.height - 2])).all(axis=1)
        kept = [(names[k], found[k].round(2).tolist()) for k in np.flatnonzero(inside)]
        points = [{"name": point, "xy": xy} for point, xy in kept]
        draft.clicks[name] = {"points": points, "drawn": []}


def detections_of(draft, camera, rng):
    """Return detections of the people: pixels with noise, in arbitrary order."""
    frames, count = draft.people.shape[:2]
    order = np.array([rng.permutation(count) for _ in range(frames)])
    pixels = camera.pixels(draft.people)
    pixels = pixels + rng.normal(0, draft.pixel_noise, pixels.shape)
    pixels = np.take_along_axis(pixels, order[:, :, None, None], axis=1)
    confidence = rng.uniform(0.45, 0.95, pixels.shape[:-1])
    seen = np.isfinite(pixels).all(axis=-1)
    few = seen.sum(axis=-1) < 6
    pixels[~seen | few[..., None]] = np.nan
    confidence[np.isnan(pixels[..., 0])] = np.nan
    with np.errstate(invalid="ignore"):
        gone = np.where(few[..., None], np.nan, 0.0)
        low = np.where(np.isnan(pixels), np.inf, pixels).min(axis=2) - 8 + gone
        high = np.where(np.isnan(pixels), -np.inf, pixels).max(axis=2) + 8 + gone
    score = np.where(few, np.nan, rng.uniform(0.6, 0.99, (frames, count)))
    found = {"frame": np.arange(frames), "keypoints": pixels, "confidence": confidence}
    return found | {"boxes": np.concatenate([low, high], axis=-1), "score": score}


def drawn_line(draft, camera, name, count, rng, noise=0.6):
    """Pixels along a line of the pitch as a camera sees it; empty where it is out of view."""
    start, end = (np.array(law_points()[each]) for each in LINES[name])
    along = start + np.linspace(0, 1, 400)[:, None] * (end - start)
    along[:, 2] = -0.2 * (along[:, 1] / 34.0) ** 2
    pixels = camera.pixels(along)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    if len(pixels) < 2:
        return []
    chosen = pixels[np.linspace(0, len(pixels) - 1, count).round().astype(int)]
    chosen = chosen + rng.normal(0, noise, chosen.shape)
    return np.clip(chosen, 0, [camera.width - 1, camera.height - 1]).round(2).tolist()


def write(draft, folder):
    """Write the match folder; nothing is checked."""
    annotations = folder / "annotations" / "static_calibration"
    annotations.mkdir(parents=True)
    (folder / "detections").mkdir()
    spec = yaml.safe_dump(draft.spec, sort_keys=False, allow_unicode=True)
    (folder / "match.yaml").write_text(spec)
    if draft.given is not None:
        (folder / "calibration.toml").write_text(toml_text(draft.given))
    if draft.pitch is not None:
        (folder / "pitch.json").write_text(json.dumps(draft.pitch))
    for name, content in draft.clicks.items():
        (annotations / f"{name}.json").write_text(json.dumps(content))
    for name, arrays in draft.seen.items():
        file = folder / "detections" / name
        if draft.coco:
            file.with_name(f"{name}.json").write_text(json.dumps(coco_results(arrays)))
        else:
            file.with_name(f"{name}.npz").write_bytes(npz_bytes(arrays))
    for spoil in draft.after:
        spoil(folder)


def npz_bytes(arrays):
    """The arrays as an npz file, in the types that readers expect."""
    packed, types = io.BytesIO(), {"frame": "<i8"}
    np.savez(packed, **{n: np.asarray(v, types.get(n, "<f4")) for n, v in arrays.items()})
    return packed.getvalue()


def coco_results(arrays):
    """The same people as COCO keypoint results."""
    results = []
    for row, person in np.ndindex(arrays["score"].shape):
        points, confidence = (arrays[name][row, person] for name in ("keypoints", "confidence"))
        if np.isfinite(confidence).any():
            x0, y0, x1, y1 = map(float, arrays["boxes"][row, person].round(2))
            triples = np.nan_to_num(np.column_stack([points, confidence]))
            about = {"image_id": int(arrays["frame"][row]), "category_id": 1}
            about["keypoints"] = triples.ravel().round(3).tolist()
            score = float(arrays["score"][row, person])
            results.append({**about, "bbox": [x0, y0, x1 - x0, y1 - y0], "score": score})
    return results


def toml_text(tables):
    """Tables of plain values as TOML."""
    lines = []
    for key, table in tables.items():
        lines += [f"[{key}]", *(f"{name} = {json.dumps(value)}" for name, value in table.items())]
    return "\n".join(lines).replace("NaN", "nan").replace("Infinity", "inf") + "\n"
