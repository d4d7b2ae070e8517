"""Changes of clocks and views that are planted within a clip, and found as by a run."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from camera_faults import perturb, with_pose
from common import tell
from registry import Table, Tables, benchmark, duration, integer, option

from data_contracts.arrays import ClipArray, Floats
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import CameraChange
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.simulation.foreign.matches import simulate_foreign_scene
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import MatchOptions
from worldpose.tracking.tracker import Tracking, track_people
from worldpose.triangulation.camera_changes import correct_views, find_changes, sum_clip
from worldpose.triangulation.change_search import add_changes, follow_changes
from worldpose.triangulation.clocks import shift_in_time
from worldpose.triangulation.settings import TriangulationSettings

KINDS = ("none", "knock", "sag", "step", "drift")

OURS = ("penalty-box", "match", "crossing", "hard")


@dataclass
class Film:
    """What static cameras see of a clip.

    Attributes:
        cameras: as stated, with small errors, by name.
        keypoints: (frames, cameras, detections, 17, 2) [px].
        confidence: (frames, cameras, detections, 17).
        person: (frames, cameras, detections) true person; -1 = none.
        fps: [1/s].
        planted: (row after a sudden change or None, size [frame] or None) by name of a camera.
    """

    cameras: dict[str, Camera]
    keypoints: Floats
    confidence: Floats
    person: Floats
    fps: float
    planted: dict[str, tuple[int | None, float | None]]


@benchmark(
    "camera_changes",
    "clocks that step or drift, cameras that are knocked or sag, within a clip: found",
    integer("clips", 10, "of each kind"),
    integer("seed", 0),
    option("--world", choices=("second", "first"), default="second"),
    option("--kinds", nargs="*", default=list(KINDS), choices=KINDS),
    option("--fps", type=float, help="frame rate; that of the scenario without it"),
    duration(12.0),
)
def count_changes(options: Namespace) -> Tables:
    """One to three cameras have a clock that steps by 1 to 12 frames or drifts by 0.2 to 1 %.

    One camera is knocked by 0.2 to 3 degrees, or sags by 0.5 degrees per ten minutes. Found: each
    size of a clock within 0.3 frames, each knock within 0.5 s, and no other camera.
    """
    rows = []
    for kind in options.kinds:
        clips = found = accused = 0
        for n in range(options.clips):
            rng = np.random.default_rng([options.seed + n, KINDS.index(kind)])
            film = draw_film(options, options.seed + n, rng)
            if film is None or not plant(kind, film, rng):
                continue
            changes = search(film)
            others = {each.camera for each in changes} - set(film.planted)
            is_right = not others and all(is_found(film, name, changes) for name in film.planted)
            clips, found, accused = clips + 1, found + is_right, accused + bool(others)
            tell(f"{options.seed + n} {kind} {film.planted}: {'found' if is_right else changes}")
        rows.append([kind, clips, found, accused])
    columns = ["planted", "clips", "right", "with another camera named"]
    return {"changes": Table(f"changes within clips, {options.world} world", columns, rows)}


def draw_film(options: Namespace, seed: int, rng: np.random.Generator) -> Film | None:
    """Return a clip of either world, by cameras with the errors of a good calibration."""
    cameras, seconds = int(rng.integers(4, 13)), options.duration
    if options.world == "second":
        rates = {"rates": (options.fps,)} if options.fps else {}
        scenario = FOREIGN_SCENARIOS["foreign-match"].model_copy(
            update={"unsynchronised": 0.0, **rates}
        )
        players = int(rng.integers(6, 17))
        scene = simulate_foreign_scene(
            scenario,
            seed,
            MatchOptions(duration=seconds, cameras=cameras, players=players, calibrated=True),
        )
        true = {name: each.camera for name, each in scene.cameras.items()}
        reports, fps = [scene.reports[name] for name in true], scene.fps
        seen = KeypointDetections.stack([each.observations for each in reports])
        person = np.full(seen.score.shape, -1)
        for camera, report in zip(person.swapaxes(0, 1), reports, strict=True):
            camera[:, : report.person.shape[1]] = report.person
    else:
        ours = SCENARIOS[OURS[seed % len(OURS)]]
        rig = ours.rig.model_copy(update={"cameras": cameras, "clock_std_frames": 0.0})
        fps = options.fps or ours.fps
        changes = {"fps": fps, "duration": seconds, "rig": rig, "broadcast": ()}
        filmed = simulate_scene(ours.model_copy(update=changes), seed)
        true, views = filmed.cameras, filmed.static_views()
        seen, person = views.detections, views.person
    points = np.array(seen.keypoints, np.float64)
    middle = np.array([0.0, 0.0, 1.0])
    sigma = [1.5e-4] * 3
    stated = {
        name: perturb(
            camera,
            np.array([*sigma, *[2e-4 * np.linalg.norm(camera.center - middle)] * 3, 5e-4]),
            rng,
        )
        for name, camera in true.items()
    }
    return Film(stated, points, np.array(seen.confidence, np.float64), person, fps, {})


def plant(kind: str, film: Film, rng: np.random.Generator) -> bool:
    """Plant a change; return False if too few cameras see people."""
    frames, cameras = film.person.shape[:2]
    seen = (film.person >= 0).sum(axis=(0, 2))
    eligible = np.flatnonzero(seen >= 2 * frames)
    most = min(len(eligible), cameras - 3, int(rng.integers(1, 4)))
    if len(eligible) < 3 or most < 1:
        return False
    at, row = np.arange(frames), int(rng.uniform(0.2, 0.8) * frames)
    names, late = list(film.cameras), np.zeros((cameras, frames))
    if kind in ("step", "drift"):
        for c in rng.choice(eligible, most, replace=False):
            sign = float(rng.choice([-1, 1]))
            if kind == "step":
                row = int(rng.uniform(0.2, 0.8) * frames)
                late[c, row:] = sign * rng.integers(1, 13)
            else:
                late[c] = sign * rng.uniform(0.002, 0.01) * at
            film.planted[names[c]] = (row if kind == "step" else None, float(late[c, -1]))
        shift_clocks(film, late)
    elif kind != "none":
        c = int(rng.choice(eligible))
        share = np.asarray(at >= row, np.float64) if kind == "knock" else at / (frames - 1.0)
        way = rng.uniform(0.0, 2.0 * np.pi)
        angle = np.radians(0.5 * frames / film.fps / 600.0)
        if kind == "knock":
            angle = np.radians(np.exp(rng.uniform(np.log(0.2), np.log(3.0))))
        turn_camera(film, c, angle * np.array([np.sin(way), np.cos(way), 0.0]), share)
        film.planted[names[c]] = (row if kind == "knock" else None, None)
    return True


def shift_clocks(film: Film, late: Floats) -> None:
    """Show what cameras see `late` (cameras, frames) frames later."""
    frames, cameras, _ = film.person.shape
    index = np.full((frames, cameras, int(film.person.max()) + 1), -1, np.int16)
    frame, camera, slot = np.nonzero(film.person >= 0)
    index[frame, camera, film.person[frame, camera, slot].astype(int)] = slot
    moved = shift_in_time(
        KeypointDetections.from_keypoints(film.keypoints, film.confidence, index), -late
    )
    more = max(0, index.shape[2] - film.keypoints.shape[2])
    wide = [(0, 0), (0, 0), (0, more)]
    film.keypoints = np.pad(film.keypoints, [*wide, (0, 0), (0, 0)], constant_values=np.nan)
    film.confidence = np.pad(film.confidence, [*wide, (0, 0)], constant_values=np.nan)
    for c in np.flatnonzero(late.any(axis=1)):
        film.keypoints[:, c], film.confidence[:, c] = np.nan, np.nan
        film.keypoints[:, c, : index.shape[2]] = moved.keypoints[:, c]
        film.confidence[:, c, : index.shape[2]] = moved.confidence[:, c]


def turn_camera(film: Film, c: int, turn: Floats, share: Floats) -> None:
    """Show what camera `c` sees while it turns by `share` (frames,) of a rotation vector [rad]."""
    camera = list(film.cameras.values())[c]
    for row in np.flatnonzero(share):
        step = Rigid.from_rotvec(share[row] * turn, np.zeros(3))
        turned = with_pose(camera, step.rotation @ camera.cam_from_world.rotation, camera.center)
        rays = camera.unproject(film.keypoints[row, c])
        moved = turned.project(rays.origins + 20.0 * rays.directions)
        inside = (moved >= 0.0) & (moved < camera.image_size)
        outside = np.asarray(~inside.all(axis=-1))
        film.keypoints[row, c] = np.where(outside[..., None], np.nan, moved)
        film.confidence[row, c][outside] = np.nan


def search(film: Film) -> list[CameraChange]:
    """Return the changes that a run finds in tracking and triangulation."""
    names, cameras = list(film.cameras), Camera.stack(list(film.cameras.values()))
    frame = np.arange(len(film.keypoints))

    def open_detections(changes: Sequence[CameraChange]) -> KeypointDetections:
        points = film.keypoints
        if changes:
            points = correct_views(points, frame, film.cameras, changes)
        return KeypointDetections.from_keypoints(points, film.confidence, frame=frame)

    def track(detections: KeypointDetections[ClipArray]) -> Tracking:
        return track_people(cameras, detections, film.fps)

    clip = follow_changes(names, cameras, film.fps, open_detections, track)
    people = replace(clip.detections, detection_index=clip.tracks.detection_index)
    sums = sum_clip(cameras, people, film.fps, frame, settings=TriangulationSettings())
    found = find_changes(cameras, people, film.fps, frame, sums)
    known, new = add_changes(clip.changes, found, names, cameras, frame, film.fps)
    return known + new


def is_found(film: Film, name: str, changes: Sequence[CameraChange]) -> bool:
    """Return whether the change of a camera is among the changes, with its size or its moment."""
    row, late = film.planted[name]
    own = [each for each in changes if each.camera == name]
    if late is not None:
        return abs(sum(each.late_frames for each in own if each.kind == "clock") - late) <= 0.3
    views = [each.frame for each in own if each.kind == "view"]
    if row is None:
        return bool(views)
    return any(at is not None and abs(at - row) <= 0.5 * film.fps for at in views)
