"""Cameras from lines that people drew into real images, and cameras without a click."""

from __future__ import annotations

import json
import time
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from camera_accuracy import ground_errors
from common import load_module, places_of_feet, quantile, simulate, tell
from registry import DATA, Table, Tables, benchmark, duration, integer, option

from data_contracts.arrays import Floats
from data_contracts.broadcast_calibration import KeyFrame
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import Side
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, DrawnMarking
from worldpose.broadcast_calibration.key_frames import calibrate_keys
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.errors import InputError, WorldposeError
from worldpose.formats.annotations.marked_images import SOCCERNET_MARKINGS
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.from_paint.paint import Ridges, guess_lens, straighten_paint
from worldpose.static_calibration.from_paint.proposal import (
    calibrate_proposal,
    propose_camera,
    propose_from_paint,
)
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.settings import CameraPrior, StaticCalibrationSettings
from worldpose.static_calibration.sides import SeenPeople, decide_sides, turn_camera
from worldpose.tracking.plane.feet import locate_feet

Lines = dict[str, list[list[float]]]
"""Drawn points of one image by marking, as shares of its width and height."""

Size = tuple[int, int]
"""Width, height [px]."""

# The scorer's template is flat. Broadcast images are crops of a zoom lens with a varying principal
# point. Main cameras of the even half with seven visible markings or more: focal length 2.6 widths
# (factor 1.34 either way), 15 m high (1.34), at a distance of 66 m (1.19), rolled by 0.006 rad,
# corners distorted inwards by 0.035 of their distance (0.015) at every zoom. Spreads here are wider
# than those; k2's, three times smaller than usual, keeps markings beyond the drawn ones from
# bending back into view.
PITCH = PitchTemplate.from_spec(PitchSpec(crown=0.0))

BROADCAST = StaticCalibrationSettings(
    prior=CameraPrior(
        focal=2.6,
        log_focal_std=0.4,
        principal_point_std=0.03,
        k1=0.033,
        k1_std=0.015,
        k2_std=0.0005,
        lens_std=(0.0, 0.0, 0.0),
        height_m=15.0,
        log_height_std=0.35,
        distance_m=70.0,
        log_distance_std=0.25,
        roll_std_rad=0.008,
    ),
    k3_gain=0.9,
)

SETS: dict[str, tuple[str, Size]] = {
    "wc14": ("wc14", (1280, 720)),
    "sn22": ("sn22_lines", (960, 540)),
}

PIXELS = (5, 10, 20)

_, SIZE = SETS["wc14"]

RIGHT_PX = 5.0
"""Largest distance of a drawn line from its marking, at a width of 960 [px]."""

WRONG_M = 0.5
"""Median ground error from which an accepted camera is wrong [m]."""

SIDE_FRAMES = 12
"""Frames whose people decide the sides, as many as the stage `proposal` takes [1]."""


@benchmark(
    "pitch_lines",
    "static cameras from lines drawn into real broadcast images",
    DATA,
    option("--half", type=int, choices=(0, 1), default=1),
    integer("every", 1, "n-th picture only"),
)
def score_line_sets(options: Namespace) -> Tables:
    """DATA holds `wc14` (lines.json, homographies.json, calib_eval.py) and `sn22_lines`.

    These are the 2014 World Cup images and a part of SoccerNet-Calibration 2022. The fit uses no
    truth; settings were tuned on the even half, the odd half is for reporting. The scored lines are
    the fitted ones: an annotation's slips count against the camera. The score with one marking left
    out cannot be gained by overfitting. Images are refused by their worst drawn pixel.
    """
    scorer, rows, overlaps = load_scorer(options.data), [], []
    for name, (_, size) in SETS.items():
        lines = load_lines(options.data, name, options.half, options.every)
        fits = fit_all(lines, size)
        scores = {
            key: jaccards(scorer, lines[key], each.estimate.camera, size)
            for key, each in fits.items()
        }
        worst = {key: max(m.worst for m in each.report.drawn) for key, each in fits.items()}
        order = sorted(scores, key=worst.__getitem__)
        for share in (1.0, 0.988, 0.95, 0.9):
            kept = order[: min(round(share * len(lines)), len(order))]
            jac = 100.0 * np.mean([scores[key] for key in kept], 0)
            rows.append([f"{name}, fitted", 100.0 * len(kept) / len(lines), *jac])
        rows.append([f"{name}, left out", None, *left_out(scorer, lines, size, BROADCAST)])
        if name == "wc14":
            overlaps = [[name, *overlap(scorer, options.data, lines, size)]]
    columns = ["lines", "complete", *(f"@{pixels} px" for pixels in PIXELS)]
    parts = Table("IoU part, no distortion", ["lines", "mean", "median"], overlaps, "%")
    return {"jaccard": Table("JaC", columns, rows, "%"), "overlap": parts}


def key_frame_lines(folder: Path) -> dict[str, Lines]:
    """Return 30 line sets, of the half that settings were not tuned on."""
    return dict(list(load_lines(folder, "wc14", 1, 1).items())[:30])


def cameras_of_key_frames(lines: Mapping[str, Lines]) -> dict[str, Camera]:
    """Return the camera of each line set as the only key frame of a clip, if there is one."""
    found: dict[str, Camera] = {}
    for name, drawn in lines.items():
        key = KeyFrame(frame=0, markings=soccernet_markings(drawn, SIZE))
        with suppress(WorldposeError):
            keys = calibrate_keys(PITCH, [key], SIZE, {}, BroadcastCalibrationSettings(), name)
            found[name] = keys.camera.camera[0]
    return found


def soccernet_markings(
    lines: Mapping[str, Sequence[Sequence[float]]], image_size: tuple[int, int]
) -> ClickedMarkings:
    """Return one image's annotation as drawn markings, without unknown names.

    Points along each marking are shares of the image's width and height.
    """
    width, height = image_size
    drawn = []
    for name, points in lines.items():
        # Annotators drag ends past the border, where nothing is visible.
        inside = [(x * width, y * height) for x, y in points if 0 <= x <= 1 and 0 <= y <= 1]
        if name in SOCCERNET_MARKINGS and inside:
            drawn.append(DrawnMarking(name=SOCCERNET_MARKINGS[name], xy=tuple(inside)))
    return ClickedMarkings(drawn=tuple(drawn))


def load_scorer(folder: Path) -> ModuleType:
    """Return the scorer of the data set."""
    return load_module(folder / "wc14" / "calib_eval.py")


def load_lines(folder: Path, name: str, half: int | None, every: int) -> dict[str, Lines]:
    """Return annotations of one set by image."""
    lines = json.loads((folder / SETS[name][0] / "lines.json").read_text())
    keys = sorted(lines)
    keys = keys if half is None else keys[half::2]
    return {key: lines[key] for key in keys[::every]}


def fit(lines: Lines, size: Size, settings: StaticCalibrationSettings) -> StaticCalibration | None:
    """Return the camera of one image; None if calibration refuses it."""
    try:
        return calibrate_camera(PITCH, soccernet_markings(lines, size), size, settings=settings)
    except InputError:
        return None


def fit_all(lines: Mapping[str, Lines], size: Size) -> dict[str, StaticCalibration]:
    """Return the cameras of all images that are not refused."""
    fits = {key: fit(drawn, size, BROADCAST) for key, drawn in lines.items()}
    return {key: each for key, each in fits.items() if each is not None}


def as_json(camera: Camera) -> dict[str, Any]:
    """Return a camera in the scorer's form."""
    (fx, fy), (cx, cy) = camera.focal, camera.principal_point
    return {
        "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "R": camera.cam_from_world.rotation,
        "t": camera.cam_from_world.translation,
        "k": camera.coefficients,
    }


def jaccards(scorer: ModuleType, lines: Lines, camera: Camera, size: Size) -> list[float]:
    """Return JaC at every pixel threshold."""
    shares = []
    for pixels in PIXELS:
        hit, extra, lost, _ = scorer.jaccard(lines, as_json(camera), np.array(size, float), pixels)
        shares.append(hit / max(hit + extra + lost, 1))
    return shares


def left_out(
    scorer: ModuleType, lines: dict[str, Lines], size: Size, settings: StaticCalibrationSettings
) -> np.ndarray:
    """Return shares of markings predicted by the camera of all others, per pixel threshold."""
    hits = []
    for drawn in lines.values():
        for name, points in drawn.items():
            others = {other: xy for other, xy in drawn.items() if other != name}
            found = fit(others, size, settings)
            predicted = {}
            if found is not None:
                camera = as_json(found.estimate.camera)
                predicted = scorer.image_lines(camera, np.array(size, float))
            off = np.inf
            if name in predicted:
                pixels = np.array(points, float) * size
                off = scorer.to_polyline(pixels, predicted[name]).max()
            hits.append([off <= limit for limit in PIXELS])
    return np.asarray(100.0 * np.mean(hits, axis=0))


def overlap(
    scorer: ModuleType, folder: Path, lines: dict[str, Lines], size: Size
) -> tuple[float, float]:
    """Return mean and median IoU of the seen part [%] of distortion-free fits to homographies."""
    truth = json.loads((folder / "wc14" / "homographies.json").read_text())
    settings = BROADCAST.model_copy(update={"distortion": "none"})
    x, y = 105.0 / scorer.TEMPLATE_W, 68.0 / scorer.TEMPLATE_H
    world_from_template = np.array([[x, 0, -52.5], [0, -y, 34.0], [0, 0, 1]])
    shares = []
    for key, drawn in lines.items():
        found = fit(drawn, size, settings)
        if found is None:
            shares.append(0.0)
            continue
        camera = as_json(found.estimate.camera)
        plane = np.column_stack([camera["R"][:, :2], camera["t"]])
        homography = np.array(camera["K"]) @ plane @ world_from_template
        shares.append(100.0 * scorer.iou_part(np.array(truth[key], float), homography, size))
    return float(np.mean(shares)), float(np.median(shares))


@benchmark(
    "proposals",
    "static cameras without a click: how many, and how many of those are wrong",
    option("part", choices=("simulation", "lines", "sides")),
    option("names", nargs="*", help="scenarios, or DATA of lines"),
    integer("surveys", 4),
    integer("first", 0),
    integer("count", 100, "of line sets"),
    duration(4.0),
)
def score_proposals(options: Namespace) -> Tables:
    """simulation: rendered stills of the static cameras of simulated stadiums.

    Ground: the true pixel of a player's place, back through the camera onto the pitch [m].

    lines: lines that people drew into broadcast images (`wc14`, `sn22_lines`), without their names,
    as paint; a fifth is dropped, and four random segments are added. Error: half of the drawn
    lines are nearer to their marking [px of 960].

    sides: people seen by cameras with errors of calibration, half of them turned by half a turn.
    The side of the first camera is stated; those of the others follow from the people in twelve
    frames. Error 1 is a wrong side.
    """
    seeds = range(options.first, options.first + options.surveys)
    limit = {"simulation": WRONG_M, "lines": RIGHT_PX, "sides": 0.5}[options.part]
    outcomes: list[Outcome] = []
    for name in options.names or ("match",):
        if options.part == "lines":
            part = drawn_lines(Path(name), options)
        elif options.part == "sides":
            part = simulate_sides(name, seeds, options.duration)
        else:
            part = simulate_stills(name, seeds)
        for each in part:
            tell(f"{each.name}: {each.accepted}, {each.error:.3g} {each.reason}")
            outcomes.append(each)
    accepted = np.array([each.accepted for each in outcomes])
    errors = np.array([each.error for each in outcomes])
    known, refused = accepted & np.isfinite(errors), ~accepted & np.isfinite(errors)
    row = [len(outcomes), 100.0 * accepted.mean(), quantile(errors[known])]
    row += [quantile(errors[known], 0.95), int((errors[known] > limit).sum())]
    row += [
        int((errors[refused] <= limit).sum()),
        quantile(np.array([e.seconds for e in outcomes])),
    ]
    columns = ["images", "accepted [%]", "error, median", "95 %", f"wrong (over {limit:g})"]
    columns += ["right, not accepted", "CPU [s]"]
    return {"cameras": Table(options.part, columns, [row])}


@dataclass(frozen=True, eq=False)
class Outcome:
    """One image.

    Attributes:
        name: of the image.
        accepted: whether the camera is used without a click.
        error: median ground error [m], or median distance of lines [px].
        seconds: CPU time.
        reason: why it is not accepted.
    """

    name: str
    accepted: bool
    error: float
    seconds: float
    reason: str = ""


def side_of(camera: Camera, pitch: PitchTemplate) -> Side:
    """Return the side of the pitch on which a camera stands."""
    x, y = camera.center[:2] / [pitch.length, pitch.width]
    if abs(y) > abs(x):
        return "near" if y < 0.0 else "far"
    return "left" if x < 0.0 else "right"


def simulate_stills(scenario: str, seeds: range) -> Iterator[Outcome]:
    """Yield the outcomes of all static cameras of some surveys."""
    for seed in seeds:
        settings, scene = simulate(scenario, seed, 0.2)
        painted = PitchTemplate.from_spec(settings.pitch)
        pitch = PitchTemplate.from_spec(scene.surveyed)
        places = places_of_feet(scene.truth.joints[::3], painted)
        for name, true in scene.cameras.items():
            still = render_pitch(true, painted, scene.poses[:, 0], seed)
            start = time.process_time()
            label = f"{scenario} {seed} {name}"
            try:
                proposal = propose_camera(still, pitch, side=side_of(true, pitch))
                found = calibrate_proposal(pitch, proposal, still)
            except InputError as refused:
                seconds = time.process_time() - start
                yield Outcome(label, False, np.nan, seconds, refused.found)
                continue
            seconds = time.process_time() - start
            off = ground_errors(found.estimate.camera, true, places, painted)
            middle = float(np.median(off)) if len(off) else np.nan  # no player is in view
            yield Outcome(label, True, middle, seconds)


def simulate_sides(scenario: str, seeds: range, duration: float) -> Iterator[Outcome]:
    """Yield for all cameras but the first whether people decide their sides; error 1 is wrong."""
    for seed in seeds:
        settings, scene = simulate(scenario, seed, duration)
        pitch, rng = PitchTemplate.from_spec(scene.surveyed), np.random.default_rng(seed)
        frames = scene.truth.frames
        frames = frames[np.linspace(0, len(frames) - 1, SIDE_FRAMES).astype(int)]
        seen: dict[str, SeenPeople] = {}
        turned: dict[str, bool] = {}
        for name, camera in scene.given.items():
            turned[name] = bool(seen) and rng.random() < 0.5
            assumed = turn_camera(camera) if turned[name] else camera
            own = scene.observations[name]
            people = KeypointDetections.stack([own[np.flatnonzero(np.isin(own.frame, frames))]])
            feet = locate_feet(Camera.stack([assumed]), people, pitch)
            seen[name] = SeenPeople(assumed, feet.xy[:, 0], feet.noise[:, 0])
        start = time.process_time()
        decided = decide_sides(seen, (next(iter(seen)),), pitch, frames / settings.fps)
        seconds = time.process_time() - start
        for name, decision in list(decided.items())[1:]:
            is_wrong = float(decision.turned is not turned[name])
            known = decision.turned is not None
            reason = f"evidence {decision.evidence:.0f}"
            label = f"{scenario} {seed} {name}"
            yield Outcome(label, known, is_wrong if known else np.nan, seconds, reason)


def as_ridges(lines: Sequence[Floats]) -> Ridges:
    """Return pixels (m, 2) along polylines, with normals."""
    points, normals = [], []
    for line in lines:
        for start, end in pairwise(line):
            length = float(np.linalg.norm(end - start))
            if length < 1.0:
                continue
            share = np.arange(0.0, length) / length
            points.append(start + share[:, None] * (end - start))
            angle = np.arctan2(end[1] - start[1], end[0] - start[0]) + 0.5 * np.pi
            normals.append(np.full(len(share), angle % np.pi))
    places = np.concatenate(points)
    inside = ((places >= 0.0) & (places <= np.array(SIZE) - 1.0)).all(axis=1)
    return Ridges(places[inside], np.concatenate(normals)[inside])


def line_error(camera: Camera, drawn: Mapping[str, Floats], pitch: PitchTemplate) -> float:
    """Return the median over drawn lines of the distance from their marking [px of 960].

    The pitch's halves may be exchanged.
    """
    medians = []
    for turn in (1.0, -1.0):
        errors = []
        for name, line in drawn.items():
            pixels = camera.project(pitch.marking_points(name, 0.25) * [turn, turn, 1.0])
            pixels = pixels[np.isfinite(pixels).all(axis=1)]
            if len(pixels) < 2:
                errors.append(np.inf)
                continue
            away = np.linalg.norm(line[:, None] - pixels, axis=-1).min(axis=1)
            errors.append(float(np.median(away)) * 960.0 / SIZE[0])
        medians.append(float(np.median(errors)))
    return min(medians)


def drawn_lines(data: Path, options: Namespace) -> Iterator[Outcome]:
    """Yield the outcomes of drawn lines."""
    pitch = PitchTemplate.standard()
    listed = {}
    named = {*pitch.lines, *pitch.arcs}
    for name in ("wc14", "sn22_lines"):
        for key, lines in json.loads((data / name / "lines.json").read_text()).items():
            listed[f"{name} {key}"] = lines
    order = np.random.default_rng(0).permutation(sorted(listed))
    for key in order[options.first : options.first + options.count]:
        rng = np.random.default_rng(list(key.encode()))
        drawn = {
            law: np.array(line) * SIZE
            for name, line in listed[key].items()
            if (law := SOCCERNET_MARKINGS.get(name)) in named and law is not None
        }
        shown = [line for line in drawn.values() if rng.random() >= 0.2]
        for _ in range(4):
            start = rng.uniform([0.0, 0.3 * SIZE[1]], SIZE)
            angle, length = rng.uniform(0.0, np.pi), rng.uniform(50.0, 200.0)
            way = length * np.array([np.cos(angle), 0.4 * np.sin(angle)])
            shown.append(np.stack([start, start + way]))
        start_time = time.process_time()
        whole = np.ones(SIZE[::-1], np.bool_)
        paint = straighten_paint(as_ridges(shown), whole, guess_lens(0.0, SIZE), 1.0)
        proposal = propose_from_paint([paint], pitch, side="near")
        seconds = time.process_time() - start_time
        if proposal is None:
            yield Outcome(key, False, np.nan, seconds, "no camera fits")
            continue
        error = line_error(proposal.camera, drawn, pitch)
        yield Outcome(key, proposal.is_clear, error, seconds, f"margin {proposal.margin:.0f}")
