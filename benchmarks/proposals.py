"""Prints how many cameras are calibrated without a click, and how many of those are wrong.

    python benchmarks/proposals.py simulation [SCENARIO ...] [--surveys 4] [--first 0]
    python benchmarks/proposals.py lines DATA [--count 100] [--drop 0.2] [--clutter 4] [--first 0]
    python benchmarks/proposals.py images FILE ... [--out FOLDER]
    python benchmarks/proposals.py sides [SCENARIO ...] [--surveys 4] [--first 0] [--duration 4]
    python benchmarks/proposals.py match FOLDER --out FOLDER
    python benchmarks/proposals.py pair DATA

simulation: rendered stills of the static cameras of simulated stadiums. Ground: the true pixel of a
player's place, back through the calibrated camera onto the pitch.

lines: lines that people drew into broadcast images (`wc14/lines.json`, `sn22_lines/lines.json`),
without their names, as paint; some are dropped, and random segments are added. A camera is wrong if
half of the drawn lines are farther than 5 px of 960 from their marking.

images: files, each with one line and an overlay in the folder.

sides: simulated people seen by cameras with errors of calibration, half of them turned by half a
turn. The side of the first camera is stated; those of the others follow from the people in twelve
frames. A side is wrong, or right, or not decided.

match: a match folder of `worldpose simulate --render` with clicks, for example `--scenario
broadcast-pan --seed 850 --duration 1`. A copy without stills and annotations, in which one static
camera states its side, and the folder itself run from videos to bodies; one line of metrics each.

pair: the two real cameras in `static_pair`, each alone, without clicks and from its clicks: how far
apart they project places of the pitch, each on its own surface, and the share of these distances
inside the sum of both 95 % regions.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import yaml
from static_accuracy import ground_errors

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "real"))
import static_pair
from static_pair import CROWN

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import Side
from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.formats.challenge import read_camera
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate, surface_shape
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.paint_segments import Ridges, guess_lens, straighten_paint
from worldpose.static_calibration.parameters import by_step
from worldpose.static_calibration.proposal import (
    Proposal,
    calibrate_without_clicks,
    propose_camera,
    propose_from_paint,
)
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.sides import SeenPeople, decide_sides, turn_camera
from worldpose.tracking.feet import locate_feet

SIZE = (1280, 720)
"""Width, height of the images of drawn lines [px]."""
RIGHT_PX = 5.0
"""Largest distance of a drawn line from its marking, at a width of 960 [px]."""
GOOD_M = 0.05
"""Median ground error at the players of a good camera [m]."""
WRONG_M = 0.5
"""Median ground error from which an accepted camera is wrong [m]."""
CHI2_95 = 5.99
"""95 % quantile of chi-square with two degrees of freedom [1]."""
SIDE_FRAMES = 12
"""Frames whose people decide the sides, as many as the stage `proposal` takes [1]."""
SIDES = {"top": "far", "bottom": "near"}


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


def simulate(scenario: str, seeds: range) -> Iterator[Outcome]:
    """Yield the outcomes of all static cameras of some surveys."""
    settings = SCENARIOS[scenario].model_copy(update={"duration": 0.2, "broadcast": None})
    painted = PitchTemplate.from_spec(settings.pitch)
    for seed in seeds:
        scene = simulate_scene(settings, seed)
        pitch = PitchTemplate.from_spec(scene.surveyed)
        places = scene.truth.joints[::3, :, 15:17].mean(axis=2).reshape(-1, 3)
        places[:, 2] = painted.height(places[:, 0], places[:, 1])
        for name, true in scene.cameras.items():
            still = render_pitch(true, painted, scene.truth.joints[0], seed)
            start = time.process_time()
            label = f"{scenario} {seed} {name}"
            try:
                found = calibrate_without_clicks(pitch, still, side=side_of(true, pitch))
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
    settings = SCENARIOS[scenario].model_copy(update={"duration": duration, "broadcast": None})
    for seed in seeds:
        scene = simulate_scene(settings, seed)
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


def law_name(drawn: str) -> str | None:
    """Return the template's name of a line of the SoccerNet vocabulary; None for goals."""
    if drawn == "Middle line":
        return "halfway_line"
    if drawn.startswith("Circle"):
        where = drawn.split()[1]
        return "center_circle" if where == "central" else f"penalty_arc_{where}"
    words = drawn.split()
    if drawn.startswith("Side line"):
        end = SIDES.get(words[2])
        return f"touch_line_{end}" if end else f"goal_line_{words[2]}"
    if words[0] in ("Big", "Small"):
        area = "penalty_area" if words[0] == "Big" else "goal_area"
        return f"{area}_{words[2]}_{SIDES.get(words[3], 'front')}"
    return None


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


def drawn_lines(data: Path, arguments: argparse.Namespace) -> Iterator[Outcome]:
    """Yield the outcomes of drawn lines."""
    pitch = PitchTemplate.standard()
    listed = {}
    for name in ("wc14", "sn22_lines"):
        for key, lines in json.loads((data / name / "lines.json").read_text()).items():
            listed[f"{name} {key}"] = lines
    order = np.random.default_rng(0).permutation(sorted(listed))
    for key in order[arguments.first : arguments.first + arguments.count]:
        rng = np.random.default_rng(list(key.encode()))
        drawn = {
            law: np.array(line) * SIZE
            for name, line in listed[key].items()
            if (law := law_name(name)) in pitch.marking_names and law is not None
        }
        shown = [line for line in drawn.values() if rng.random() >= arguments.drop]
        for _ in range(arguments.clutter):
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
        yield Outcome(key, proposal.is_clear, error, seconds, describe(proposal))


def describe(proposal: Proposal) -> str:
    """Return a proposal's evidence in one line."""
    return (
        f"margin {proposal.margin:.0f}, {proposal.found:.0%} on paint, "
        f"{proposal.explained:.0%} explained"
    )


def images(files: Sequence[Path], out: Path | None) -> Iterator[Outcome]:
    """Yield the outcomes of images, and write overlays."""
    pitch = PitchTemplate.standard()
    places = pitch.sample_lines(0.25).points_world
    for file in files:
        picture = cv2.imread(str(file))
        if picture is None:
            raise SystemExit(f"expected {file} to be an image")
        start = time.process_time()
        try:
            proposal = propose_camera(
                np.asarray(picture[..., ::-1].copy(), np.uint8), pitch, side="near"
            )
        except InputError as refused:
            yield Outcome(file.name, False, np.nan, time.process_time() - start, refused.found)
            continue
        seconds = time.process_time() - start
        yield Outcome(file.name, proposal.is_clear, np.nan, seconds, describe(proposal))
        if out is not None:
            pixels = proposal.camera.project(places)
            for x, y in pixels[np.isfinite(pixels).all(axis=1)]:
                if 0 <= x < picture.shape[1] and 0 <= y < picture.shape[0]:
                    cv2.circle(picture, (round(x), round(y)), 1, (0, 0, 255), -1)
            out.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(out / f"{file.stem}.png"), picture)


def take_annotations(folder: Path, out: Path) -> Path:
    """Return a copy of a match folder without stills, clicks and cameras, with one side."""
    if out.exists():
        return out
    shutil.copytree(folder, out)
    for name in ("annotations", "stills"):
        shutil.rmtree(out / name, ignore_errors=True)
    (out / "calibration.toml").unlink(missing_ok=True)
    spec = yaml.safe_load((out / "match.yaml").read_text())
    spec["match_id"] += "-without-clicks"
    for camera in spec["cameras"]:
        camera.pop("still", None)
    first = spec["cameras"][0]
    true = read_camera(
        out / "reference" / "cameras" / f"{first['id']}.npz", (first["width"], first["height"])
    )
    first["side"] = side_of(true, PitchTemplate.standard())
    (out / "match.yaml").write_text(yaml.safe_dump(spec))
    return out


def compare_runs(folder: Path, out: Path) -> None:
    """Print the metrics of a run without clicks and of one with them, from videos to bodies."""

    def worldpose(*words: str | Path) -> str:
        program = (sys.executable, "-c", "from flows.cli import main; main()", *map(str, words))
        return subprocess.run(program, check=True, stdout=subprocess.PIPE, text=True).stdout

    for each in (take_annotations(folder, out / "without_clicks"), folder):
        start, project = time.perf_counter(), out / f"project_{each.name}"
        worldpose("run", each, "--project", project)
        seconds = time.perf_counter() - start
        name = yaml.safe_load((each / "match.yaml").read_text())["match_id"]
        where = ("--prediction", name, "--reference", each / "reference", "--project", project)
        found = json.loads(worldpose("evaluate", *where, "--json"))
        print(
            f"{name}: MPJPE {found['mpjpe_mm']:.1f} mm, G-MPJPE {found['g_mpjpe_mm']:.1f} mm, "
            f"{seconds:.0f} s, cameras {json.dumps(found['cameras'])}",
            flush=True,
        )


def compare_pair(data: Path) -> None:
    """Print the agreement of the two real cameras without and with clicks."""
    folder, level = data / "static_pair", PitchTemplate.from_spec(PitchSpec(crown=CROWN))
    places = np.stack(np.meshgrid(np.arange(-52.0, 53.0, 3.0), np.arange(-34.0, 35.0, 3.0)), -1)
    places = places.reshape(-1, 2)

    def see(found: StaticCalibration) -> tuple[Floats, Floats]:
        """Return pixels (n, 2) of the places and their covariances (n, 2, 2) [px^2]."""
        assert found.report.lines is not None
        known = found.report.lines.estimate
        height = level.with_surface(known.surface).height(*places.T)
        seen = known.camera.project_with_jacobians(np.column_stack([places, height]))
        shape = surface_shape(places[:, 0], places[:, 1], (level.length, level.width))
        steps = (by_step(known.camera, seen), seen.d_points[..., 2:] * shape[:, None])
        rows = np.concatenate(steps, axis=-1)
        return seen.points_image, rows @ known.covariance @ np.swapaxes(rows, 1, 2)

    for side in static_pair.SIDES:
        still = static_pair.median_still(folder, side)
        named, clicks = static_pair.clicked_pitch(folder, side)
        (first, one), (second, two) = (
            see(calibrate_without_clicks(level, still, side="near")),
            see(calibrate_camera(named, clicks, static_pair.SIZE, picture=still)),
        )
        inside = np.asarray(((first > 0.0) & (first < static_pair.SIZE)).all(axis=1))
        away = (second - first)[inside]
        squared = (away * np.linalg.solve((one + two)[inside], away[..., None])[..., 0]).sum(axis=1)
        print(
            f"{side}: {np.median(np.linalg.norm(away, axis=1)):.2f} px apart (median), "
            f"{(squared < CHI2_95).mean():.0%} in both regions"
        )


def summarize(outcomes: Sequence[Outcome], limit: float, unit: str) -> None:
    """Print the share that is accepted, the errors among those, and why others are not."""
    accepted = np.array([each.accepted for each in outcomes])
    errors = np.array([each.error for each in outcomes])
    seconds = np.median([each.seconds for each in outcomes])
    print(
        f"{len(outcomes)} images, {accepted.mean():.1%} accepted, {seconds:.1f} s of CPU (median)"
    )
    known = accepted & np.isfinite(errors)
    if known.any():
        wrong = int(np.count_nonzero(errors[known] > limit))
        print(
            f"error of the accepted [{unit}]: median {np.median(errors[known]):.3g}, "
            f"95 % {np.quantile(errors[known], 0.95):.3g}; {wrong} wrong (over {limit:g})"
        )
        if unit == "m":
            print(f"{(errors[known] <= GOOD_M).mean():.1%} of them within {100 * GOOD_M:g} cm")
    refused = ~accepted & np.isfinite(errors)
    if refused.any():
        right = int(np.count_nonzero(errors[refused] <= limit))
        print(f"{right} of {int(refused.sum())} that are not accepted are right")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("simulation", "lines", "images", "sides", "match", "pair"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--surveys", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--drop", type=float, default=0.2)
    parser.add_argument("--clutter", type=int, default=4)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--duration", type=float, default=4.0)
    arguments = parser.parse_args()
    if arguments.part == "pair":
        compare_pair(Path(arguments.names[0]))
        return
    if arguments.part == "match":
        compare_runs(Path(arguments.names[0]), arguments.out or Path("build/match"))
        return
    if arguments.part == "simulation":
        seeds = range(arguments.first, arguments.first + arguments.surveys)
        parts = [simulate(name, seeds) for name in arguments.names or ("match",)]
        limit, unit = WRONG_M, "m"
    elif arguments.part == "sides":
        seeds = range(arguments.first, arguments.first + arguments.surveys)
        names = arguments.names or ("match",)
        parts = [simulate_sides(name, seeds, arguments.duration) for name in names]
        limit, unit = 0.5, "wrong side"
    elif arguments.part == "lines":
        parts = [drawn_lines(Path(name), arguments) for name in arguments.names]
        limit, unit = RIGHT_PX, "px"
    else:
        parts = [images([Path(name) for name in arguments.names], arguments.out)]
        limit, unit = RIGHT_PX, "px"
    outcomes = []
    for part in parts:
        for each in part:
            state = "accepted" if each.accepted else "unclear"
            measured = f"{each.error:.3g} {unit}, {each.seconds:.1f} s"
            print(f"{each.name}: {state}, {measured} {each.reason}", flush=True)
            outcomes.append(each)
    summarize(outcomes, limit, unit)


if __name__ == "__main__":
    main()
