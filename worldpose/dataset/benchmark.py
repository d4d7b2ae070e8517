"""Scores of methods' folders against the clips of a data set, by the paper's protocol."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.evaluation import Evaluation, MethodScore
from worldpose.body.body_file import find_body
from worldpose.body.model import BodyModel
from worldpose.dataset.check import check_clip
from worldpose.dataset.contents import SUBMISSIONS, ShippedClip, camera_files, list_clips, read_clip
from worldpose.dataset.faults import LIMITS, camera_faults
from worldpose.dataset.manifest import FRAME_RATES, stated_rate
from worldpose.errors import InputError
from worldpose.evaluation import matching, metrics
from worldpose.formats.archives import ARRAY_BYTES, read_npz, wrong
from worldpose.formats.joints_file import PLURALS, JointTracks
from worldpose.formats.release_cameras import CameraRows, read_camera
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import align
from worldpose.ingest.match_folder import spec_around


class Sample(NamedTuple):
    """People (persons, 17, 3) [m] of one image, true and as methods found and aligned them."""

    clip: str
    frame: int
    camera: Camera | None
    true: Floats
    found: Mapping[str, Floats]


class _People(NamedTuple):
    """People of one clip as a folder has them; `first` is the match frame of its image 0."""

    folder: Path
    where: str
    tracks: JointTracks
    first: int
    clip: ShippedClip
    camera: Path | None
    bodies: tuple[str, ...]
    notes: Mapping[str, str]


FORMS: Final = ("poses/*.npz", "*.joints.npz")
"""Files of clips in a data set."""


def is_data_set(folder: Path) -> bool:
    """Return whether a folder has files by clip, or splits that have, and no `joints.npz`."""
    found = any(path for form in (*FORMS, "*/poses/*.npz") for path in folder.glob(form))
    return found and not (folder / "joints.npz").is_file()


def parts_of_clips(folder: Path) -> dict[str, Path]:
    """Return the folder of each clip, or of a release's splits; InputError for none or doubles."""
    splits = sorted({path.parents[1] for path in folder.glob("*/poses/*.npz")})
    own = any(path for form in (*FORMS, *SUBMISSIONS) for path in folder.glob(form))
    parts: dict[str, Path] = {}
    for part in splits if splits and not own else [folder, *splits]:
        for clip in list_clips(part):
            if clip in parts:
                todo = "Name one of these folders, or move the other one away."
                raise wrong(f"{folder}: clip {clip}", "one", f"{parts[clip]} and {part}", todo)
            parts[clip] = part
    return parts


def require_one_rate(rates: Mapping[str, float | None]) -> None:
    """Raise InputError if sides whose frames are paired by number state other rates [1/s].

    The rates that are stated of one video, as 29.97, 29.99 and 30, differ by up to 0.1 %.
    """
    known = {where: rate for where, rate in rates.items() if rate is not None}
    if known and max(known.values()) > 1.005 * min(known.values()):
        sides = " and ".join(f"{rate:g} in {where}" for where, rate in known.items())
        todo = (
            "Bring one side to the frames of the other, or correct the rate: fps of match.yaml, or "
        )
        todo += f"{FRAME_RATES}."
        raise wrong("frames per second", "the same on both sides", sides, todo)


def score_folders(
    reference: Path,
    predictions: Mapping[str, Path],
    *,
    body: str | None = None,
    match_in: str | None = None,
    fps: float | None = None,
) -> tuple[tuple[MethodScore, ...], Sample]:
    """Return each method's scores by clip and over all clips, and a sample of the first clip.

    A folder has `poses/<clip>.npz`, `<clip>.joints.npz` or a submission, and `cameras/<clip>.npz`.
    Tracks are matched by boxes in the reference's camera. A prediction's boxes are those of
    `boxes/<clip>.npz`, or of its joints in its own camera, or in that of the reference.

    `body` is the model of pose files that name none, `match_in` the broadcast camera of clips with
    several, by default the first, `fps` [1/s] by default what the reference states. InputError,
    with file and key, if a clip is missing, has other frames, or its camera has another convention.
    """
    settings = matching.EvaluationSettings()
    clips: dict[str, dict[str, Evaluation]] = {name: {} for name in predictions}
    people: dict[str, list[metrics.PersonScore]] = {name: [] for name in predictions}
    bodies: dict[str, set[str]] = {name: set() for name in predictions}
    notes: dict[str, dict[str, str]] = {name: {} for name in predictions}
    samples: list[Sample] = []
    parts = {name: parts_of_clips(folder) for name, folder in predictions.items()}
    for clip, part in parts_of_clips(reference).items():
        truth = _read_people(part, clip, body, match_in)
        true, camera = truth.tracks.joints, _true_camera(truth)
        stated = stated_rate(part, clip)
        shown = {}
        for name, folder in predictions.items():
            if clip not in parts[name]:
                todo = "Write its poses, with NaN where the method found no person."
                found = ", ".join(parts[name])
                raise wrong(f"{folder}: clip {clip}", f"poses/{clip}.npz or joints", found, todo)
            if camera is None and name == next(iter(predictions)):  # said once, not by each method
                notes[name][f"{reference}/cameras"] = "absent for some clips: people without boxes"
            own = stated_rate(parts[name][clip], clip)
            require_one_rate({f"{part}": stated, f"{parts[name][clip]}": own})
            mine = _read_people(parts[name][clip], clip, body, match_in, truth)
            boxes = None if camera is None else _boxes(mine, truth, camera)
            clips[name][clip], persons = metrics.evaluate_joints(
                mine.tracks, truth.tracks, settings, fps=fps or stated, camera=camera, boxes=boxes
            )
            distances = matching.joint_distances(mine.tracks.joints, true)
            _require_metres(mine, true, distances)
            match = matching.match_people(distances, settings.match_gate_m)
            sides = mine.tracks.joints, true
            tracks = matching.match_tracks(*sides, distances, match, camera, boxes, settings)
            shown[name] = matching.take_matched(mine.tracks.joints, tracks)
            people[name] += persons
            bodies[name].update(mine.bodies)
            notes[name] |= {**mine.notes, **_describe_shift(mine.where, shown[name], true)}
        samples = samples or [_sample(clip, camera, true, shown)]
    scores = []
    for name, folder in predictions.items():
        frames = sum(each.frames or 0 for each in clips[name].values())
        pooled = metrics.pool_people(people[name], settings).model_copy(update={"frames": frames})
        scores.append(
            MethodScore(
                method=name,
                title=name,
                source=folder.name,
                world="shared",
                body_model=", ".join(sorted(bodies[name])) or "joints",
                notes=notes[name],
                match_in=match_in,
                first_frame=0,
                settings=settings.model_dump(mode="json"),
                evaluation=pooled,
                clips=clips[name],
            )
        )
    return tuple(scores), samples[0]


def _read_people(
    folder: Path, clip: str, body: str | None, match_in: str | None, truth: _People | None = None
) -> _People:
    """Read the people of a clip: poses, or else joints, or else a submission."""
    used: list[str] = []
    poses = folder / "poses" / f"{clip}.npz"

    def find(named: str | None) -> BodyModel:
        if named is None and body is None:
            todo = "Install it (worldpose body install), and name it: --body smpl-neutral."
            raise wrong(f"{poses}: body_model", "the name of the body model", "no name", todo)
        used.append(named or body or "")
        return find_body(used[-1])

    clips = list_clips(folder)
    shipped = read_clip(folder, clip, clips, find, None, 50.0)
    source = shipped.sources[0]
    numbered = [each.frames for each in shipped.sources if each.frames is not None]
    first = truth.first if truth else int(numbered[0][0]) if numbered and len(numbered[0]) else 0
    rows = np.arange(len(source.points)) if source.frames is None else source.frames - first
    count = len(truth.tracks.frames) if truth else int(rows.max(initial=-1)) + 1
    key = "" if source.place is None else ": transl"
    where = f"{folder}/{source.name}{key if source.frames is None else ': frames'}"
    low, high = int(rows.min(initial=0)), int(rows.max(initial=0))
    if (source.frames is None and len(rows) != count) or low < 0 or high >= count:
        expected = f"frames {first} to {first + count - 1} of the clip"
        todo = "Write one row for each frame of the clip, with NaN where no person was found."
        raise wrong(where, expected, f"{first + low} to {first + high}", todo)
    if truth and source.frames is not None and truth.clip.sources[0].frames is not None:
        metrics.require_common(where, source.frames, truth.clip.sources[0].frames)
    joints = np.full((count, source.points.shape[1], len(COCO17), 3), np.nan)
    for place, name in enumerate(COCO17):
        if name in source.skeleton:
            joints[rows, :, place] = source.point(name)
    wanted = own = camera_files(folder, clip, clips)[0]
    if truth is None and match_in is not None:
        missing = f"{folder}/cameras/{clip}.{match_in}.npz"
        if not (wanted := [each for each in own if each.stem.endswith(f".{match_in}")]):
            raise wrong(missing, "a camera", "nothing", "Name it.")
    elif truth is not None and truth.camera is not None:
        views = camera_files(truth.folder, clip, list_clips(truth.folder))[0]
        if len(own) > 1 or len(views) > 1:
            wanted = [each for each in own if each.stem == truth.camera.stem]
        if own and not wanted:
            found = ", ".join(each.name for each in own)
            todo = "Write this camera, or name another one of the reference with --match-in."
            missing = f"{folder}/cameras/{truth.camera.name}"
            raise wrong(missing, "the camera of the reference's boxes", found, todo)
    plural = {}
    if poses.is_file():
        with zipfile.ZipFile(poses) as file:
            keys = [key for key in PLURALS if f"{key}.npy" in file.namelist()]
        read = ", ".join(f"{key} as {PLURALS[key]}" for key in keys)
        plural = {f"{poses}": f"read {read}, as public readers name it"} if keys else {}
    tracks = JointTracks(np.arange(count), np.arange(joints.shape[1]), joints)
    shape = joints[rows].shape[:3]  # poses tell no views, and joints of the same people may
    told = [each.views for each in shipped.sources if each.views is not None]
    if same := [each for each in told if each.shape == shape]:
        seen = np.zeros(joints.shape[:3], np.int64)
        seen[rows] = same[0]
        tracks = replace(tracks, views=seen)
    around = None if truth else spec_around(folder)
    tracks = metrics.drop_views(tracks, around[1] if around else None)
    camera = wanted[0] if wanted else None
    return _People(folder, where, tracks, first, shipped, camera, tuple(used), plural)


def _require_metres(mine: _People, true: Floats, distances: Floats) -> None:
    """Raise InputError if people are at the true places in another unit only."""

    def nearest(each: Floats) -> float:
        closest = each.min(axis=(1, 2), initial=np.inf)
        known = closest[np.isfinite(closest)]
        return float(np.median(known)) if len(known) else np.nan

    for unit, size in (("millimetres", 1e-3), ("centimetres", 1e-2)):
        scaled = nearest(matching.joint_distances(size * mine.tracks.joints, true))
        # No pitch has people so far from each other [m].
        if scaled < 5.0 and nearest(distances) > 150.0:
            raise wrong(mine.where, "metres", unit, f"Multiply the places by {size:g}.")


def _true_camera(truth: _People) -> Camera | None:
    """Return the reference's camera (frames,) or (); None without one.

    InputError if it has other frames than the people, or does not show them.
    """
    if truth.camera is None:
        return None
    known = {fault.name for fault in camera_faults()} | {"frame_offset", "sees_nobody"}
    for finding in check_clip(truth.clip)[1]:
        if f"cameras/{truth.camera.stem}" in finding.where and finding.fault in known:
            raise _convention(truth.camera, finding.says)
    return _read_camera(truth.camera, truth)


def _read_camera(path: Path, truth: _People) -> Camera:
    camera, count = read_camera(path), len(truth.tracks.frames)
    if camera.batch_shape not in ((), (count,)):
        rows = f"{camera.batch_shape[0]} rows"
        raise wrong(f"{path}: K", f"1 row, or {count}, as {truth.where} has frames", rows)
    return camera


def _convention(path: Path, says: str) -> InputError:
    todo = "Write it again; worldpose check names faults of a whole folder."
    key = says[0] if says[1] == " " else "R"  # most faults of cameras begin with the member
    return wrong(f"{path}: {key}", "x_cam = R x_world + t in metres", says, todo)


def _boxes(mine: _People, truth: _People, camera: Camera) -> Floats | None:
    """Return a prediction's boxes (frames, persons, 4) [px]; None = its joints in `camera`.

    InputError if only another convention of its camera shows people where the true ones are.
    """
    name = mine.clip.name if truth.camera is None else truth.camera.stem
    file, joints = mine.folder / "boxes" / f"{name}.npz", mine.tracks.joints
    if file.is_file():
        boxes = read_npz(file, ARRAY_BYTES).get("boxes", np.empty(0)).astype(np.float64)
        if boxes.shape != (expected := (*joints.shape[:2], 4)):
            raise wrong(f"{file}: boxes", f"{expected}, as {mine.where} has", f"{boxes.shape}")
        return boxes
    if mine.camera is None:
        return None
    own = _read_camera(mine.camera, truth)
    places = matching.joint_boxes(truth.tracks.joints, camera)
    least = matching.EvaluationSettings().min_overlap

    def count_matches(seen: Camera) -> int:
        overlap = matching.box_overlaps(matching.joint_boxes(joints, seen), places)
        return int((matching.match_boxes(overlap, least) >= 0).sum())

    matches = count_matches(own)
    if 2 * matches < int(np.isfinite(places).all(-1).sum()):
        rows = next(view.rows for view in mine.clip.views if view.name == mine.camera.stem)
        for fault in camera_faults():
            repaired: CameraRows = rows if fault.camera is None else fault.camera(rows)
            seen = repaired.camera() if own.batch_shape else repaired.camera()[0]
            if count_matches(seen) > max(2 * matches, len(places)):
                raise _convention(mine.camera, fault.says)
    return matching.joint_boxes(joints, own)


def _describe_shift(where: str, found: Floats, true: Floats) -> dict[str, str]:
    """Return a note if a prediction fits the reference much better some frames earlier or later."""
    errors = {}  # before and after; a short clip has frames that no shift but 0 compares
    reach = max(0, min(3, len(found) - 1))
    for late in range(-reach, reach + 1):
        mine = found[max(late, 0) : len(found) + min(late, 0)]
        theirs = true[max(-late, 0) : len(true) - max(late, 0)]
        same = true[max(late, 0) : len(true) + min(late, 0)]
        pair = []
        for each in (same, theirs):
            source, target = (metrics.paper_joints(side).reshape(-1, 3) for side in (mine, each))
            away = align(source, target, with_scale=True).apply(source) - target
            known = np.linalg.norm(away[np.isfinite(away).all(-1)], axis=-1)
            pair.append(float(known.mean()) if len(known) else np.inf)
        errors[late] = pair
    left = {late: after / before for late, (before, after) in errors.items() if after < before}
    best = min(left, key=lambda late: (left[late], abs(late)), default=0)
    if not left.get(best, 1.0) < LIMITS.max_share_left:
        return {}
    says = f"people are {abs(best)} frames {'late' if best > 0 else 'early'}: corrected, the error"
    return {
        where: f"{says} falls from {1000 * errors[best][0]:.1f} to {1000 * errors[best][1]:.1f} mm"
    }


def _sample(clip: str, camera: Camera | None, true: Floats, found: Mapping[str, Floats]) -> Sample:
    """Return the image in which most people are true and found, after the shared alignment."""
    both = [np.isfinite(each[..., 0]).any(-1).sum(-1) for each in (true, *found.values())]
    frame = int(np.sum(both, axis=0).argmax())
    moved = {}
    for name, people in found.items():
        source, target = (metrics.paper_joints(each).reshape(-1, 3) for each in (people, true))
        moved[name] = align(source, target, with_scale=True).apply(people[frame])
    here = camera[frame] if camera is not None and camera.batch_shape else camera
    return Sample(clip, frame, here, true[frame], moved)
