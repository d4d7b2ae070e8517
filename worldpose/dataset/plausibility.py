"""Plausibility of body sizes, speeds, positions on the pitch, and cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats
from data_contracts.release import Finding, ReleasedSequence
from worldpose.body.occlusions import visible_shares
from worldpose.dataset.contents import (
    CameraView,
    PointSource,
    convention,
    implausible,
    sample_evenly,
)
from worldpose.dataset.faults import (
    LATEST,
    LIMITS,
    Fault,
    camera_faults,
    frame_faults,
    point_faults,
)
from worldpose.formats.joints_file import read_joints
from worldpose.formats.release_cameras import CameraRows, read_camera
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import align, unit

BONES = {
    "upper arms": ("shoulder", "elbow"),
    "forearms": ("elbow", "wrist"),
    "thighs": ("hip", "knee"),
    "shins": ("knee", "ankle"),
}


def plausible_share(source: PointSource) -> float:
    """Return the share of bodies near the ground, head up, within the bounds.

    A body counts if its nose is 0.3 to 2.3 m above its lowest foot: this includes a kneeling person
    and excludes other units or axes, and also a lying person. If most bodies have a left-right
    swap, the share is zero.
    """
    feet, nose = _feet(source), source.point("nose")
    here = np.isfinite(feet) & np.isfinite(nose).all(-1)
    if not here.any() or _handedness(source) < 0.0:
        return 0.0
    height, middle = (nose[..., 2] - feet)[here], nose[here]
    good = (height > 0.3) & (height < 2.3) & (np.abs(feet[here]) < 1.5)
    good &= (np.abs(middle[:, :2]) <= np.array(LIMITS.bounds_m)).all(-1)
    return float(good.mean())


def world_fault(source: PointSource) -> tuple[Fault | None, float, float]:
    """Return the fault whose repair places people on the pitch; plausible share before and after.

    Among equally good faults the one with feet nearest to the ground is returned, and among these
    the first.
    """
    before = plausible_share(source)
    if before >= LIMITS.min_plausible_share:
        return None, before, before
    best, most, nearest = None, before, np.inf
    for fault in point_faults():
        points = None if fault.points is None else fault.points(source)
        if points is None:
            continue
        moved = source.with_points(points)
        share = plausible_share(moved)
        height = abs(foot_height(moved))
        if share > most + 0.01 or (share >= most - 0.01 and height < nearest - 0.02):
            best, most, nearest = fault, share, height
    return (best, before, most) if most >= LIMITS.min_plausible_share else (None, before, before)


def foot_height(source: PointSource) -> float:
    """Return the median height of people's lower foot above z = 0 [m]; NaN without people."""
    feet = _feet(source)
    return float(np.median(feet[np.isfinite(feet)])) if np.isfinite(feet).any() else np.nan


def ground_findings(source: PointSource) -> Iterator[Finding]:
    """Yield feet above or below the pitch, and for poses whether their pivot explains it."""
    height = foot_height(source)
    if np.isnan(height) or LIMITS.min_ground_m <= height <= LIMITS.max_ground_m:
        return
    says = f"people's lower foot is {height:.2f} m from the ground in half of all frames"
    fault, left, make = "feet_off_the_ground", height, implausible
    if source.pivot is not None:
        moved = source.with_points(source.points + source.pivot[:, :, None])
        left = foot_height(moved)
        if LIMITS.min_ground_m <= left <= LIMITS.max_ground_m and abs(left) < 0.5 * abs(height):
            fault, make = "root_about_origin", convention
            says += "; on the ground if global_orient turned about the model's origin"
    yield make(fault, says, source.name, foot_height_m=height, explained_height_m=left)


def body_findings(source: PointSource, fps: float) -> Iterator[Finding]:
    """Yield implausible limb lengths and speeds."""
    for name, (upper, lower) in BONES.items():
        bone = np.stack(
            [
                np.linalg.norm(
                    source.point(f"{side}_{upper}") - source.point(f"{side}_{lower}"), axis=-1
                )
                for side in ("left", "right")
            ],
            axis=-1,
        )
        seen = np.flatnonzero(np.isfinite(bone).any((0, 2)))
        lengths = np.array([np.nanmedian(bone[:, person]) for person in seen])
        low, high = LIMITS.bones_m
        if (wrong := (lengths < low) | (lengths > high)).any():
            says = f"{name} of {int(wrong.sum())} people are not of human length"
            figures = {"least_m": float(lengths.min()), "greatest_m": float(lengths.max())}
            yield implausible("limb_length", says, source.name, **figures)
    middle = _hips(source)
    speed = np.linalg.norm(np.diff(middle, axis=0), axis=-1) * fps
    speed = speed[np.isfinite(speed)]
    if (
        len(speed)
        and (share := float((speed > LIMITS.max_speed_m_s).mean())) > LIMITS.max_fast_share
    ):
        says = f"people move faster than {LIMITS.max_speed_m_s:g} m/s"
        figures = {"share_of_steps": share, "fastest_m_per_s": float(speed.max())}
        yield implausible("speed", says, source.name, **figures)


def pitch_findings(source: PointSource) -> Iterator[Finding]:
    """Yield people off the pitch."""
    middle = _hips(source)
    here = np.isfinite(middle).all(-1)
    away = np.abs(middle[here][:, :2]) > np.array(LIMITS.bounds_m)
    if len(away) and (share := float(away.any(-1).mean())) > 1.0 - LIMITS.min_plausible_share:
        says = "people are far off the pitch"
        yield implausible("off_the_pitch", says, source.name, share_of_bodies=share)


def camera_findings(name: str, rows: CameraRows) -> Iterator[Finding]:
    """Yield invalid rotations, and a moving camera's centre that is not constant."""
    rotation, translation = rows.rotation, rows.translation
    known = np.isfinite(rotation).all((-1, -2)) & np.isfinite(translation).all(-1)
    rotation, translation = rotation[known], translation[known]
    if not len(rotation):
        return
    where = (f"cameras/{name}",)
    residual = float(np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max())
    if residual > LIMITS.max_rotation_error:
        yield Finding(
            fault="rotation_not_orthonormal",
            kind="damage",
            where=where,
            says="R is no rotation matrix",
            figures={"residual": residual},
        )
        return
    if (np.linalg.det(rotation) < 0.0).any():
        yield convention("mirrored_rotation", "R mirrors: its determinant is -1", *where)
    drift = float(np.linalg.norm(centers(rows) - camera_center(rows), axis=-1).max())
    if drift > LIMITS.max_center_drift_m:
        says = "the camera's centre -R't is not in one place"
        yield implausible("moving_center", says, *where, drift_m=drift)


def centers(rows: CameraRows) -> Floats:
    """Return the centres (n, 3) [m], world, of a camera's rows with a pose."""
    all_centers = -(np.swapaxes(rows.rotation, -1, -2) @ rows.translation[..., None])[..., 0]
    found: Floats = all_centers[np.isfinite(all_centers).all(-1)]
    return found


def camera_center(rows: CameraRows) -> Floats:
    """Return the median centre (3,) [m], world; NaN for a camera without a pose."""
    found = centers(rows)
    return np.median(found, axis=0) if len(found) else np.full(3, np.nan)


def _hips(source: PointSource) -> Floats:
    """Return the mid-hip of all people (frames, persons, 3) [m]."""
    return 0.5 * (source.point("left_hip") + source.point("right_hip"))


def _handedness(source: PointSource) -> float:
    """Return 1 if most noses or toes point ahead, according to left and up; -1 if behind."""

    def middle(name: str) -> Floats:
        return 0.5 * (source.point(f"left_{name}") + source.point(f"right_{name}"))

    if "left_ear" in source.skeleton:
        left = source.point("left_ear") - source.point("right_ear")
        forward = source.point("nose") - middle("ear")
    else:
        left = source.point("left_hip") - source.point("right_hip")
        forward = middle("big_toe") - middle("ankle")
    ahead = (np.cross(left, middle("shoulder") - middle("hip")) * forward).sum(-1)
    ahead = ahead[np.isfinite(ahead)]
    return float(np.median(np.sign(ahead))) if len(ahead) else 0.0


def _feet(source: PointSource) -> Floats:
    """Return the height (frames, persons) [m] of every body's lowest foot above z = 0."""
    parts = ("big_toe", "heel", "ankle")
    foot_points = [f"{side}_{part}" for part in parts for side in ("left", "right")]
    soles = [name for name in foot_points if name in source.skeleton]
    lift = 0.0
    # Height of an ankle above the ground if a skeleton has no sole [m].
    ankle_height_m = 0.09
    if soles and all("ankle" in name for name in soles):
        lift = ankle_height_m
    elif any("heel" in name for name in soles):
        soles = [name for name in soles if "ankle" not in name]
    z = source.points[:, :, [source.skeleton.index(name) for name in soles], 2]
    lowest: Floats = np.where(np.isnan(z), np.inf, z).min(-1) - lift
    return np.where(np.isinf(lowest), np.nan, lowest)


STAND: Final = (0.5, 150.0)
"""Minimum and maximum height of a camera above the ground [m]."""


def visible_share(source: PointSource, points: Floats, rows: CameraRows) -> float:
    """Return the share of people that a camera shows upright and at a person's size.

    `points` (frames, persons, points, 3) [m] are in the world. A camera with an implausible or
    varying position has the share zero.
    """
    people = 4000  # maximum number of sampled bodies
    # Distance of a camera's centre from its median beyond which its pose is invalid [m].
    travel = 2.0
    center = camera_center(rows)
    # Maximum distance of a camera from the centre spot [m].
    max_distance_m = 500.0
    if not STAND[0] < center[2] < STAND[1] or np.linalg.norm(center) > max_distance_m:
        return 0.0
    if np.linalg.norm(centers(rows) - center, axis=-1).max() > travel:
        return 0.0
    ends = points[:, :, [source.skeleton.index(n) for n in ("nose", "left_ankle", "right_ankle")]]
    known = np.all(np.isfinite(ends), axis=(-1, -2))
    moving = len(rows.rotation) > 1
    if moving:
        posed = np.all(np.isfinite(rows.rotation), axis=(-1, -2))[: len(known)]
        known[: len(posed)] &= posed[:, None]
        known[len(posed) :] = False
    frame, person = np.nonzero(known)
    if not len(frame):
        return 0.0
    picked = sample_evenly(len(frame), people)
    camera = rows.camera()
    camera = camera[frame[picked]] if moving else camera[0]
    pixels = camera.project(ends[frame[picked], person[picked]])
    tall = pixels[:, 1:, 1].mean(-1) - pixels[:, 0, 1]
    inside = (pixels >= 0.0) & (pixels <= camera.image_size[..., None, :])
    # Minimum and maximum height of a person in the image [px].
    heights_px = (8.0, 1500.0)
    shown = inside.all((-1, -2)) & (tall > heights_px[0]) & (tall < heights_px[1])
    return float(shown.mean())


def is_blind(source: PointSource, rows: CameraRows) -> bool:
    """Return whether a camera shows fewer people than expected.

    A static camera can show an empty part of the pitch: it is only expected to be upright in the
    stadium with the pitch in the centre of its image. For a moving camera nothing is known without
    people in frames with a pose.
    """
    if visible_share(source, source.points, rows) >= LIMITS.min_visible_share:
        return False
    if len(rows.rotation) > 1:
        posed = np.all(np.isfinite(rows.rotation), axis=(-1, -2))[: len(source.points)]
        there = source.points[: len(posed)][posed]
        return not posed.any() or bool(np.isfinite(there).all(-1).any())
    center, forward, down = camera_center(rows), rows.rotation[0, 2], rows.rotation[0, 1]
    if not STAND[0] < center[2] < STAND[1] or not forward[2] < 0.0 or not down[2] < 0.0:
        return True
    middle = center - forward * center[2] / forward[2]
    return bool((np.abs(middle[:2]) > np.array(LIMITS.bounds_m)).any())


def visibility_findings(
    source: PointSource, views: Sequence[CameraView]
) -> Iterator[tuple[Finding, Fault | None]]:
    """Yield findings on cameras that show too few people, and the fault that explains each.

    One writer makes one mistake: among the faults whose repair lets cameras show at least ten times
    `min_visible_share` of the people, the fault that explains most cameras comes first.
    """
    if not views:
        return
    faults = (*camera_faults(), *point_faults())
    share = np.zeros((len(faults), len(views)))
    for row, fault in enumerate(faults):
        points = source.points if fault.points is None else fault.points(source)
        if points is not None:
            for column, view in enumerate(views):
                rows = view.rows if fault.camera is None else fault.camera(view.rows)
                share[row, column] = visible_share(source, points, rows)
    share[share < 10.0 * LIMITS.min_visible_share] = 0.0
    left = np.ones(len(views), dtype=np.bool_)
    while left.any():
        worth = (share > 0.0)[:, left].sum(1) + share[:, left].mean(1)
        best = int(worth.argmax())
        explained = left & (share[best] > 0.0)
        if not explained.any():
            break
        left &= ~explained
        yield _make_finding(views, explained, faults[best], share[best]), faults[best]
    if left.any():
        yield _make_finding(views, left, None, share.max(0, initial=0.0)), None


def _make_finding(
    views: Sequence[CameraView], which: Flags, fault: Fault | None, share: Floats
) -> Finding:
    where = tuple(f"cameras/{view.name}" for view, ours in zip(views, which, strict=True) if ours)
    figures = {"explained_share_seen": float(share[which].min())}
    if fault is not None:
        says = f"{fault.says}: so the camera shows people"
        return convention(fault.name, says, *where, **figures)
    says = "the camera shows no person of the clip"
    return Finding(fault="sees_nobody", kind="damage", where=where, says=says, figures=figures)


def turning_findings(source: PointSource, view: CameraView) -> Iterator[Finding]:
    """Yield the frame offset that explains a source and a camera's 2D, independent of its poses."""
    posed = np.isfinite(view.rows.rotation).all((-1, -2))
    shared = view.shared_points(source)
    if shared is None:
        return
    if posed.mean() > 0.5 or not np.isfinite(camera_center(view.rows)).all():
        return
    seen, points = shared[0], source.points[:, :, shared[1]]
    left, still = (
        {late: _left(seen, points, view.rows, late, at) for late, at in shifts}
        for shifts in (
            [(late, late) for late in range(-LATEST, LATEST + 1)],
            [(late, 0) for late in range(-LATEST, LATEST + 1)],
        )
    )
    gains = {late: left[late] / still[late] for late in left if left[late] < still[late]}
    best = min(gains, key=lambda late: (gains[late], abs(late)), default=0)
    if (
        gains
        and still[best] - left[best] > LIMITS.min_gain_px
        and gains[best] < LIMITS.max_share_left
    ):
        (fault,) = (f for f in frame_faults(moving=False) if f.later_points == best)
        figures = {"shipped_median_px": min(still[best], 1e6), "explained_median_px": left[best]}
        where = source.name, f"cameras/{view.name}"
        yield convention(fault.name, fault.says, *where, **figures)


def _left(seen: Floats, points: Floats, rows: CameraRows, late: int, at: int) -> float:
    """Return the median residual [px] between 2D and 3D `at` frames later, by optimal rotations.

    It is of the frames that have one `late` frames later. A frame without enough points is skipped;
    infinite without any frame.
    """
    camera, center = rows.lens(), camera_center(rows)
    first, last = max(0, -late), min(len(seen), len(points) - late, len(rows.rotation))
    errors = []
    # Maximum number of sampled frames.
    max_frames = 150
    # Minimum number of points of a frame for a rotation estimate: more than one person.
    min_points = 30
    for frame in first + sample_evenly(last - first, max_frames):
        here, there = seen[frame].reshape(-1, 2), points[frame + at].reshape(-1, 3)
        plane = camera[int(frame)].normalize(here)
        known = np.isfinite(plane).all(-1) & np.isfinite(there).all(-1)
        if known.sum() < min_points:
            continue
        plane = plane[known]
        rays = unit(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))
        ways = unit(there[known] - center)
        # With their opposites, directions are turned about the camera alone.
        both = (np.concatenate([each, -each]) for each in (ways, rays))
        turned = ways @ align(*both, with_scale=False).rotation.T
        ahead = turned[:, 2:] > 0.0
        away = np.where(ahead, turned[:, :2] / np.where(ahead, turned[:, 2:], 1.0) - plane, np.inf)
        errors.append(np.linalg.norm(away * camera.focal[frame], axis=-1))
    return float(np.median(np.concatenate(errors))) if errors else np.inf


def mean_visible(joints: Floats, camera: Camera) -> float | None:
    """Return the mean of `visible_shares` over people and frames [1]; None without people."""
    shares = visible_shares(joints, camera)
    return float(np.nanmean(shares)) if np.isfinite(shares).any() else None


def rig_findings(
    part: Path, name: str, clip: ReleasedSequence, rigs: dict[tuple[str, str], bytes]
) -> Iterator[Finding]:
    """Yield faults of a clip's static cameras; `rigs` has the files of the match's other clips."""
    files = {path.stem: path for path in (part / "cameras" / name).glob("*.npz")}
    rig = clip.rig or {}
    # A camera whose lens Brown's model cannot follow has a reason instead of a file.
    if files.keys() != {each for each in rig if "reason" not in (rig[each].lens or {})}:
        says = "static cameras are not those of the files"
        yield Finding(fault="views_differ", kind="damage", where=(name,), says=says)
    joints = read_joints(part / f"{name}.joints.npz").joints
    for each in sorted(files.keys() & rig):
        camera = read_camera(files[each], rig[each].image_size)
        content, key = files[each].read_bytes(), (clip.match_id, each)
        same = camera.batch_shape == () and content == rigs.setdefault(key, content)
        # The file has the view before its changes, with which later frames must not be projected.
        is_shown = same and not rig[each].changes
        seen, stated = (mean_visible(joints, camera) if is_shown else None), rig[each].visible
        if not same or abs((seen or 0.0) - (stated or 0.0)) > 1e-6:
            where = (f"{clip.split}/cameras/{name}/{each}.npz",)
            says = "not the camera of the match's rig, or it shows other people than stated"
            yield Finding(fault="camera_differs", kind="damage", where=where, says=says)
