"""Faults and clock offsets that are planted into cameras, and found."""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import quantile, tell
from registry import Table, Tables, benchmark, integer, option

import worldpose
from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.consistency import check_consistency
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.foreign.matches import simulate_foreign_scene
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import MatchOptions
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.clocks import shift_in_time
from worldpose.triangulation.synchronization import Synchronization, shift_frames, synchronize

KINDS = ("flipped", "mirrored", "focal", "lens", "clock", "frame_rate", "swapped", "duplicate")

LENS_ORDERS = ([0, 1, 3, 4, 2], [0, 1, 4, 2, 3], [2, 3, 0, 1, 4])
"""Positions from which a reader with another order takes k1 k2 p1 p2 k3."""

SHIFTS = np.array([-12.0, -3.5, 0.0, 2.25, 20.0])

WANTED = 0.2
"""Largest error that counts as found [frame]."""

CASES = {"tiny": 16, "crossing": 8, "penalty-box": 8, "match": 4, "hard": 4}

FINE = 4

TILT = 1e-3


@benchmark(
    "camera_faults",
    "faults planted into cameras of the second world: found and named",
    integer("rigs", 60),
    integer("seed", 0),
    option("--kinds", nargs="*", default=list(KINDS)),
)
def count_faults(options: Namespace) -> Tables:
    """Each rig comes twice, with one fault, of each kind in turn, and without.

    Rigs, people and detector are those of the second world (`worldpose.simulation.foreign`), which
    shares nothing with the simulator that the check was developed on. Named: cameras and kind are
    right. Half of the rigs that lack a fault of the lens state a covariance.
    """
    planted: Counter[str] = Counter()
    named: Counter[str] = Counter()
    others: Counter[str] = Counter()
    false: list[str] = []
    for n in range(options.rigs):
        kind = options.kinds[n % len(options.kinds)]
        for one in (kind, None):
            rig = draw_rig(options.seed * 100_000 + 2 * n + (one is None), one)
            result = check_consistency(
                Camera.stack(rig.cameras),
                rig.covariance,
                KeypointDetections.from_keypoints(rig.keypoints, rig.confidence),
                rig.fps,
                ConsistencySettings(),
                ground=True,
            )
            cameras = {fault.camera for fault in result.faults}
            kinds = {fault.kind for fault in result.faults}
            if one is None:
                false += [f"{fault.camera} {fault.kind}" for fault in result.faults[:1]]
                continue
            right = bool(cameras) and cameras <= set(rig.faulty) and kinds == {kind}
            planted[kind] += 1
            named[kind] += right
            others[kind] += bool(cameras & set(rig.faulty)) and not right
            tell(f"{n} {kind} {rig.about}: {'named' if right else sorted(kinds)}")
    rows = [[kind, planted[kind], named[kind], others[kind]] for kind in planted]
    rows.append(["all", planted.total(), named.total(), others.total()])
    columns = ["planted", "rigs", "named", "other kind or camera too"]
    without = [["none", options.rigs, len(false)]]
    return {
        "faults": Table("planted faults", columns, rows),
        "without": Table("without a fault", ["planted", "rigs", "falsely named"], without),
    }


@dataclass
class Rig:
    """Stated and true cameras, and the detections in their videos.

    Attributes:
        cameras: as stated.
        true: the true cameras.
        world: (frames, persons, 17, 3) [m].
        covariance: (cameras, 12, 12) of the stated cameras; None = not given.
        keypoints: (frames, cameras, detections, 17, 2) [px].
        confidence: (frames, cameras, detections, 17).
        fps: [1/s].
        faulty: cameras that count as correct when named.
        about: the planted fault.
    """

    cameras: list[Camera]
    true: list[Camera]
    world: Floats
    covariance: Floats | None
    keypoints: Floats
    confidence: Floats
    fps: float
    faulty: tuple[int, ...] = ()
    about: str = ""


def draw_rig(seed: int, kind: str | None) -> Rig:
    """Return a rig with a fault of `kind`, or without."""
    for attempt in range(50):
        rng = np.random.default_rng([seed, attempt])
        scenario = FOREIGN_SCENARIOS["foreign-match"].model_copy(update={"unsynchronised": 0.0})
        scene = simulate_foreign_scene(
            scenario,
            seed + 1_000_000 * attempt,
            MatchOptions(
                duration=rng.uniform(4.0, 8.0),
                cameras=int(rng.integers(4, 19)),
                players=int(rng.integers(5, 23)),
                calibrated=True,
            ),
        )
        names, middle = list(scene.cameras), np.nanmedian(scene.truth.joints, axis=(0, 1, 2))
        true = [scene.cameras[name].camera for name in names]
        stated = rng.random() < 0.5 and kind not in ("focal", "lens")
        scale = rng.uniform(0.3, 1.5) if stated else 0.2
        sigmas = np.zeros((len(true), 12))
        for sigma, camera in zip(sigmas, true, strict=True):
            distance = float(np.linalg.norm(camera.center - middle))
            sigma[:7] = scale * np.array([1e-3] * 3 + [1.5e-3 * distance] * 3 + [3e-3])
        seen = KeypointDetections.stack([scene.reports[name].observations for name in names])
        rig = Rig(
            [perturb(*each, rng) for each in zip(true, sigmas, strict=True)],
            true,
            scene.truth.joints,
            np.stack([np.diag(sigma**2) for sigma in sigmas]) if stated else None,
            np.array(seen.keypoints, np.float64),
            np.array(seen.confidence, np.float64),
            scene.fps,
        )
        shown = np.zeros((len(true), *rig.world.shape[:2]), np.bool_)
        for camera, name in zip(shown, names, strict=True):
            for row, people in zip(camera, scene.reports[name].person, strict=True):
                row[people[people >= 0]] = True
        # Mean number of people that each pair of cameras sees in common.
        together = np.array([[(a & b).sum(1).mean() for b in shown] for a in shown])
        np.fill_diagonal(together, 0.0)
        eligible = [c for c in range(len(true)) if np.sort(together[c])[-2] >= 2.0]
        if len(eligible) >= 3 and (kind is None or plant(kind, rig, eligible, rng)):
            return rig
    raise RuntimeError(f"no rig for seed {seed}")


def perturb(camera: Camera, sigma: Floats, rng: np.random.Generator) -> Camera:
    """Return the camera with a random calibration error of `sigma` (12,)."""
    step = rng.normal(0, sigma)
    pose = camera.cam_from_world
    turned = Rigid.from_rotvec(step[:3], np.zeros(3)) @ Rigid(pose.rotation, pose.translation)
    return replace(
        camera,
        focal=camera.focal * np.exp(step[6]),
        cam_from_world=Rigid(turned.rotation, -turned.rotation @ (camera.center + step[3:6])),
    )


def with_pose(camera: Camera, rotation: Floats, center: Floats) -> Camera:
    """Return the camera with another pose."""
    return replace(camera, cam_from_world=Rigid(rotation, -rotation @ center))


def plant(kind: str, rig: Rig, eligible: list[int], rng: np.random.Generator) -> bool:
    """Plant a fault into the rig; return False, with the rig unchanged, if it cannot have it."""
    c = int(rng.choice(eligible))
    camera = rig.cameras[c]
    rotation, center = camera.cam_from_world.rotation, camera.center
    faulty: tuple[int, ...] = (c,)
    if kind == "flipped":
        half = np.diag([-1.0, -1.0, 1.0])
        rig.cameras[c] = with_pose(camera, rotation @ half, half @ center)
    elif kind == "mirrored":
        way = int(rng.integers(4))
        rig.about = ("image", "left/right names", "near/far names", "mirrored pose")[way]
        if way == 0:
            points = rig.keypoints[:, c]
            points[..., 0] = camera.image_size[0] - 1.0 - points[..., 0]
            rig.keypoints[:, c] = points[..., COCO17_FLIP, :]
            rig.confidence[:, c] = rig.confidence[:, c][..., COCO17_FLIP]
        elif way < 3:
            turn = np.diag([-1.0, 1.0, -1.0] if way == 1 else [1.0, -1.0, -1.0])
            rig.cameras[c] = with_pose(camera, rotation @ turn, turn @ center)
        else:
            mirror = np.diag([1.0, -1.0, 1.0] if rng.random() < 0.5 else [-1.0, 1.0, 1.0])
            flip = np.diag([-1.0, 1.0, 1.0])
            rig.cameras[c] = with_pose(camera, flip @ rotation @ mirror, mirror @ center)
    elif kind == "focal":
        ratio = float(np.exp(rng.choice([-1, 1]) * rng.uniform(np.log(1.08), np.log(1.35))))
        rig.about = f"x {ratio:.3f}"
        rig.cameras[c] = replace(camera, focal=camera.focal * ratio)
    elif kind == "lens":
        order = LENS_ORDERS[int(rng.integers(len(LENS_ORDERS)))]
        misread = replace(camera, distortion=camera.distortion[order])
        shift = lens_shift(rig.true[c], misread, rig.world)
        if not shift > 4.0:
            return False
        rig.cameras[c] = misread
        rig.about = f"{order} {shift:.0f} px"
    elif kind in ("clock", "frame_rate"):
        frames = len(rig.keypoints)
        if kind == "clock":
            late = int(rng.choice([-1, 1]) * rng.integers(4, min(40, frames // 3)))
            time = np.arange(frames) + late
            rig.about = f"{late} frames"
        else:
            rate = float(rng.choice([0.5, 2.0, 25 / 30, 30 / 25, 24 / 25, 25 / 24, 50 / 60]))
            time = np.round(np.arange(frames) * rate).astype(int)
            rig.about = f"x {rate:.3f}"
        inside = (time >= 0) & (time < frames)
        for array in (rig.keypoints, rig.confidence):
            moved = np.full_like(array[:, c], np.nan)
            moved[inside] = array[time[inside], c]
            array[:, c] = moved
    else:
        other = int(rng.choice([n for n in range(len(rig.cameras)) if n != c]))
        faulty = (c, other)
        rig.about = f"{c} and {other}"
        if kind == "swapped":
            for array in (rig.keypoints, rig.confidence):
                array[:, [c, other]] = array[:, [other, c]]
        else:
            jitter = rng.normal(0, rng.choice([0.0, 0.7]), rig.keypoints[:, c].shape)
            rig.keypoints[:, other] = rig.keypoints[:, c] + jitter
            rig.confidence[:, other] = rig.confidence[:, c]
            faulty = (other, c)
    rig.faulty = faulty
    return True


def lens_shift(true: Camera, stated: Camera, world: Floats) -> float:
    """Return the mean image shift of people by a wrong lens [px]."""
    points = world[::25].reshape(-1, 3)
    a, b = true.project(points), stated.project(points)
    inside = ((a >= 0) & (a < true.image_size)).all(-1)
    return float(np.nanmean(np.linalg.norm((a - b)[inside], axis=-1)))


@benchmark(
    "synchronization",
    "clock offsets of cameras, found without a hint",
    option("--shelf", type=Path, help="data with shelf_dev; simulated clips without it"),
    integer("first", 100, "seed of the first simulated clip"),
)
def score_clocks(options: Namespace) -> Tables:
    """Cameras are shifted by -12, -3.5, 0, 2.25 and 20 frames in several orders.

    Real detections are tracked and interpolated between frames; their own offsets, estimated before
    the shift, count as true. Simulated are 40 clips of 4 s in five scenarios, at four times the
    frame rate, so that fractions are exact, before five cameras whose orientation has an error of 1
    mrad per axis. Found: all offsets within 0.2 frames.
    """
    if options.shelf is None:
        cases = simulate_cases(options.first)
    else:
        given = options.shelf / "shelf_dev" / "import"
        known = worldpose.read_cameras(given / "calibration.toml")
        files = [given / "detections" / f"{name}.json" for name in known]
        seen = KeypointDetections.stack([worldpose.read_observations(file) for file in files])
        cases = shift_real_detections(Camera.stack(list(known.values())), seen, 25.0)
    rows = list(cases)
    found = sum(row[-1] for row in rows)
    columns = ["case", "worst [frame]", "not told", "largest deviation [frame]", "found"]
    return {"clocks": Table(f"{found} of {len(rows)} cases found", columns, rows)}


def orders(cameras: int) -> Iterator[Floats]:
    """Yield the shifts (cameras,) of five orders [frame]."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        yield np.resize(SHIFTS, max(cameras, 5))[rng.permutation(max(cameras, 5))][:cameras]


def shift(
    cameras: Camera, seen: KeypointDetections, fps: float, late: Floats
) -> tuple[KeypointDetections, Floats]:
    """Return detections whose frame t shows the time t + late, and these offsets."""
    people = track_people(cameras, seen, fps).detection_index
    every = np.arange(len(late))
    if not people.shape[2]:
        whole = np.rint(late)
        return shift_frames(seen, every, -whole.astype(np.int64)), whole
    return shift_in_time(seen.assign_people(people), -late), late


def report(name: str, found: Synchronization, true: Floats) -> list[Any]:
    """Return a row; the last value is whether all offsets are found within `WANTED`."""
    off = found.late - true
    off = off - np.nanmedian(off) if np.isfinite(off).any() else off
    unknown = int(np.isnan(off).sum())
    worst = float(np.nanmax(np.abs(off))) if unknown < len(off) else np.nan
    is_found = unknown == 0 and bool(worst <= WANTED)
    return [name, worst, unknown, quantile(found.std, 1.0), is_found]


def shift_real_detections(
    cameras: Camera, seen: KeypointDetections, fps: float
) -> Iterator[list[Any]]:
    """Yield the rows of shifted real detections."""
    own = synchronize(cameras, seen, fps)
    for late in orders(int(cameras.batch_shape[0])):
        moved, true = shift(cameras, seen, fps, late)
        found = synchronize(cameras, moved, fps)
        yield report(str(true.tolist()), found, true + own.late)


def simulate_cases(first: int) -> Iterator[list[Any]]:
    """Yield the rows of simulated cases."""
    for name, count in CASES.items():
        for seed in range(first, first + count):
            scenario = SCENARIOS[name]
            fps, before, frames = scenario.fps, 20, round(4.0 * scenario.fps)
            rig = scenario.rig.model_copy(update={"cameras": 5, "clock_std_frames": 0.0})
            seconds = (frames + before + 25) / fps
            changes = {"fps": FINE * fps, "duration": seconds, "rig": rig, "broadcast": ()}
            scene = simulate_scene(scenario.model_copy(update=changes), seed)
            rng = np.random.default_rng(seed)
            late = SHIFTS[rng.permutation(5)]
            rows = np.rint(FINE * (np.arange(frames)[:, None] + before + late)).astype(int)
            given = scene.static_views().detections
            arrays = {n: array[rows, np.arange(5)] for n, array in given.arrays().items()}
            cameras = []
            for camera in scene.cameras.values():
                error = Rigid.from_rotvec(rng.normal(0.0, TILT, 3), np.zeros(3))
                cameras.append(replace(camera, cam_from_world=error @ camera.cam_from_world))
            found = synchronize(
                Camera.stack(cameras),
                KeypointDetections(frame=np.arange(frames), **arrays),
                fps,
                pitch=PitchTemplate.from_spec(scenario.pitch),
            )
            yield report(f"{name} {seed} {late.tolist()}", found, late)
