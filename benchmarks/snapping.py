"""Prints whether moving clicks to the paint near them makes cameras more accurate.

    python benchmarks/snapping.py simulation [SCENARIO ...] [--first 70] [--cameras 6] [--clicks 0]
    python benchmarks/snapping.py pair DATA

simulation: clicks with an error of 3 px per axis on rendered stills. A click moves to the crossing
of the two clearest lines of paint near it. Each camera is calibrated from the clicks alone and with
the painted lines, before and after. Ground: as in `static_accuracy.py`, median over the players.

pair: the hand clicks of the two real cameras in `static_pair`, as they are and with 3 px added. The
reference is the camera that is found without clicks. A snap more than 10 px from the hand click is
wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from static_accuracy import ground_errors

from data_contracts.arrays import Floats, Image
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint
from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.paint_segments import find_paint
from worldpose.static_calibration.proposal import calibrate_without_clicks
from worldpose.video.folder import median_picture, open_video

sys.path.append(str(Path(__file__).parents[1] / "tests" / "real"))
import static_pair

NOISE = 3.0
"""Standard deviation of clicks, each axis [px]."""
REACH, WINDOW = 0.006, 0.014
"""Largest move of a click, and radius of the paint that decides it, in image widths [1]."""
WRONG_PX = 6.0
"""Error from which a snapped click of the simulation is wrong [px]."""


def paint_pixels(picture: Image) -> Floats:
    """Return pixels (n, 2) on the middle of thin paint [px]."""
    return next(find_paint(picture)).origins


def snap(paint: Floats, click: Floats, width: int) -> Floats | None:
    """Return the crossing of the two clearest lines of paint near a click, if there is one."""
    near = paint[np.linalg.norm(paint - click, axis=1) < WINDOW * width]
    tolerance, lines = width / 1500.0, []
    for _ in range(2):
        best = np.zeros(len(near), np.bool_)
        for angle in np.linspace(0.0, np.pi, 60, endpoint=False):
            offset = near @ [np.cos(angle), np.sin(angle)]
            on = np.abs(offset[:, None] - offset) < tolerance
            row = on[int(on.sum(axis=1).argmax())] if len(near) else best
            if row.sum() > best.sum():
                best = row
        if best.sum() < 6:
            return None
        middle = near[best].mean(axis=0)
        normal = np.linalg.svd(near[best] - middle, full_matrices=False)[2][1]
        lines.append((normal, float(middle @ normal)))
        near = near[np.abs(near @ normal - lines[-1][1]) > 2.0 * tolerance]
    normals = np.stack([normal for normal, _ in lines])
    if abs(np.linalg.det(normals)) < 0.15:
        return None
    crossing = np.linalg.solve(normals, [offset for _, offset in lines])
    return crossing if np.linalg.norm(crossing - click) < REACH * width else None


def spread_out(points: Mapping[str, Floats], count: int) -> list[str]:
    """Return names of points far from each other."""
    names = list(points)
    chosen = names[:1]
    while len(chosen) < min(count, len(names)):
        left = (name for name in names if name not in chosen)
        chosen.append(
            max(left, key=lambda n: min(np.linalg.norm(points[n] - points[c]) for c in chosen))
        )
    return chosen


def simulate(scenario: str, seed: int, most: int, clicks: int) -> None:
    """Print a line per camera of a simulated survey, and the medians."""
    settings = SCENARIOS[scenario].model_copy(update={"duration": 0.2, "broadcast": None})
    painted, scene = PitchTemplate.from_spec(settings.pitch), simulate_scene(settings, seed)
    pitch = PitchTemplate.from_spec(scene.surveyed)
    places = scene.truth.joints[::3, :, 15:17].mean(axis=2).reshape(-1, 3)
    places[:, 2] = painted.height(places[:, 0], places[:, 1])
    ground = {name: place for name, place in painted.points.items() if abs(place[2]) < 0.5}
    rows, moved, wrong = [], 0, 0
    for number, (name, true) in enumerate(list(scene.cameras.items())[:most]):
        rng = np.random.default_rng([seed, number])
        still = render_pitch(true, painted, scene.truth.joints[0], seed)
        width, height = (int(side) for side in true.image_size)
        pixels = dict(zip(ground, true.project(np.array(list(ground.values()))), strict=True))
        seen = {
            point: pixel
            for point, pixel in pixels.items()
            if ((pixel > 5.0) & (pixel < [width - 6.0, height - 6.0])).all()
        }
        chosen = spread_out(seen, clicks) if clicks else list(seen)
        given = {point: seen[point] + rng.normal(0.0, NOISE, 2) for point in chosen}
        paint, snapped = paint_pixels(still), dict(given)
        for point, click in given.items():
            found = snap(paint, click, width)
            if found is not None:
                snapped[point], moved = found, moved + 1
                wrong += bool(np.linalg.norm(found - seen[point]) > WRONG_PX)
        errors = []
        for each in (given, snapped):
            points = tuple(ClickedPoint(name=n, xy=(x, y)) for n, (x, y) in each.items())
            for picture in (None, still):
                try:
                    camera = calibrate_camera(
                        pitch, ClickedMarkings(points=points), (width, height), picture=picture
                    ).estimate.camera
                    off = ground_errors(camera, true, places, painted)
                    errors.append(float(np.median(off)))
                except InputError:
                    errors.append(np.nan)
        rows.append(errors)
        print(f"{scenario} {seed} {name}: {len(given)} clicks,", *np.round(errors, 4), flush=True)
    medians = np.round(np.nanmedian(rows, axis=0), 4)
    print(f"{moved} clicks moved, {wrong} wrong; ground [m] clicks {medians[0]} -> {medians[2]},")
    print(f"with painted lines {medians[1]} -> {medians[3]}")


def real_pair(data: Path) -> None:
    """Print what snapping does to hand clicks of two real cameras."""
    pitch = PitchTemplate.from_spec(PitchSpec(crown=static_pair.CROWN))
    folder, rng, total = data / "static_pair", np.random.default_rng(75), 0
    before: list[float] = []
    after: list[float] = []
    shifts: list[float] = []
    for side in static_pair.SIDES:
        with open_video(folder / f"{side}_camera.mp4") as video:
            numbers = (static_pair.SIDES[side] + np.linspace(8, 47, 25)).astype(int).tolist()
            images = (image for n in numbers for _, image in video.frames(n, n + 1))
            still = median_picture(images, len(numbers))
        found = calibrate_without_clicks(pitch, still, side="near")
        lines = found.report.lines
        there = pitch if lines is None else pitch.with_surface(lines.estimate.surface)
        paint, (places, pixels) = paint_pixels(still), static_pair.read_clicks(folder, side)
        for name, pixel in pixels.items():
            if name not in pitch.points:
                continue
            x, y = places[name]
            place = np.array([[x, y, float(there.height(x, y))]])
            reference = found.estimate.camera.project(place)[0]
            for noise in (0.0, NOISE):
                click, total = np.array(pixel) + rng.normal(0.0, 1.0, 2) * noise, total + 1
                crossing = snap(paint, click, still.shape[1])
                if crossing is not None:
                    before.append(float(np.linalg.norm(click - reference)))
                    after.append(float(np.linalg.norm(crossing - reference)))
                    shifts.append(float(np.linalg.norm(crossing - pixel)))
    print(f"{len(shifts)} of {total} clicks moved, {np.median(shifts):.1f} px from the hand click")
    print(f"wrong: {np.count_nonzero(np.array(shifts) > 10.0)}; distance to the camera without")
    print(f"clicks {np.median(before):.1f} -> {np.median(after):.1f} px")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("simulation", "pair"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--first", type=int, default=70)
    parser.add_argument("--cameras", type=int, default=6)
    parser.add_argument("--clicks", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.part == "pair":
        real_pair(Path(arguments.names[0]))
        return
    for scenario in arguments.names or ("match",):
        simulate(scenario, arguments.first, arguments.cameras, arguments.clicks)


if __name__ == "__main__":
    main()
