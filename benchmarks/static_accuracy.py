"""Prints the accuracy of static cameras on simulated images, and the coverage of their regions.

    python benchmarks/static_accuracy.py [SCENARIO ...] [--surveys 19] [--first 0]

Clicks and mistakes are the scenario's own, the survey has the scenario's errors, one image per
camera with people in it. Ground: the true pixel of a player's place, back through the estimated
camera onto the pitch. Wrong clicks: recall and precision of calibration from clicks. Regions: share
of cameras inside their stated region. Each line has results of clicks (stages 1 and 2), then with
the image's lines (stage 3).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.stats import chi2

from data_contracts.arrays import Floats, Image
from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.evaluation.cameras import surface_points
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.report import StaticCalibration

SHARES = (0.5, 0.8, 0.95, 0.99)
BORDER = 4.0
"""Points nearer to the image border count as outside [px]."""
SHORT = 60.0
"""A marking with a shorter part in the image counts as invisible [px]."""
MANY = 8
"""Minimum number of markings of a camera that sees many."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of one camera.

    Attributes:
        ground: errors at the players from clicks, and with lines [m].
        region: probability mass of the estimate's distribution nearer than the true camera, for
            both.
        markings: number of markings that the camera sees.
        wrong: names of wrong clicks.
        named: names of clicks that calibration reported as wrong.
        weak: whether the report asks for a user's check, from clicks.
        refined: whether lines contributed to the camera.
    """

    ground: tuple[Floats, ...]
    region: tuple[float, ...]
    markings: int
    wrong: frozenset[str]
    named: frozenset[str]
    weak: bool
    refined: bool


def ground_errors(found: Camera, true: Camera, places: Floats, pitch: PitchTemplate) -> Floats:
    """Return the distance between places and the back-projections of their true pixels [m]."""
    pixels = true.project(places)
    seen = ((pixels > 0.0) & (pixels < true.image_size - 1.0)).all(axis=-1)
    met = surface_points(found.unproject(pixels[seen]), pitch)
    off = np.linalg.norm(met - places[seen], axis=-1)
    return np.asarray(np.where(np.isfinite(off), off, np.hypot(pitch.length, pitch.width)))


def markings_seen(camera: Camera, pitch: PitchTemplate) -> int:
    """Return the number of painted markings in a camera's image."""
    count = 0
    for name in (*pitch.lines, *pitch.arcs):
        pixels = camera.project(pitch.marking_points(name, 0.25))
        inside = np.all((pixels > BORDER) & (pixels < camera.image_size - BORDER), axis=-1)
        steps = np.linalg.norm(np.diff(pixels, axis=0), axis=-1)[inside[1:] & inside[:-1]]
        count += bool(steps.sum() > SHORT)
    return count


def region(estimate: CameraEstimate, true: Camera) -> float:
    """Return the estimate's probability mass that is nearer to it than the true camera."""
    camera = estimate.camera
    off = true.cam_from_world @ camera.cam_from_world.inverse()
    step = np.concatenate(
        [
            off.rotvec,
            off.translation,
            [np.log(true.focal[0] / camera.focal[0])],
            true.principal_point - camera.principal_point,
            (true.distortion - camera.distortion)[[0, 1, 4]],
        ]
    )
    free = np.diag(estimate.covariance) > 0.0
    inner = estimate.covariance[np.ix_(free, free)]
    squared = step[free] @ np.linalg.solve(inner, step[free])
    return float(chi2.cdf(squared, free.sum()))


def calibrate_both_ways(
    surveyed: PitchTemplate, clicked: ClickedMarkings, size: tuple[int, int], still: Image
) -> list[StaticCalibration]:
    """Return the calibration from clicks, and that with the image's lines."""
    return [calibrate_camera(surveyed, clicked, size, picture=each) for each in (None, still)]


def outcomes(scenario: str, seeds: range) -> Iterator[Outcome | None]:
    """Yield the cameras of some surveys, None for a camera that calibration refuses."""
    settings = SCENARIOS[scenario].model_copy(update={"duration": 0.2, "broadcast": None})
    painted = PitchTemplate.from_spec(settings.pitch)
    for seed in seeds:
        scene = simulate_scene(settings, seed)
        surveyed = PitchTemplate.from_spec(scene.surveyed)
        places = scene.truth.joints[::3, :, 15:17].mean(axis=2).reshape(-1, 3)
        places[:, 2] = painted.height(places[:, 0], places[:, 1])
        for name, true in scene.cameras.items():
            clicks = scene.clicks[name]
            size = (int(true.image_size[0]), int(true.image_size[1]))
            people = scene.truth.joints[0]
            still = np.asarray(
                cv2.cvtColor(render_pitch(true, painted, people, seed), cv2.COLOR_RGB2GRAY),
                np.uint8,
            )
            try:
                found = calibrate_both_ways(surveyed, clicks.markings, size, still)
            except InputError:
                yield None
                continue
            yield Outcome(
                ground=tuple(
                    ground_errors(each.estimate.camera, true, places, painted) for each in found
                ),
                region=tuple(region(each.estimate, true) for each in found),
                markings=markings_seen(true, painted),
                wrong=frozenset(clicks.wrong),
                named=frozenset(found[0].report.wrong),
                weak=found[0].report.weak,
                refined=found[1].report.stage == "lines",
            )


def ground(cameras: list[Outcome], stage: int) -> str:
    """Return the errors at players, over all cameras."""
    errors = 100.0 * np.concatenate([each.ground[stage] for each in cameras])
    return f"{np.median(errors):.2f} / {np.percentile(errors, 95.0):.2f} cm"


def tell(scenario: str, every: list[Outcome | None]) -> None:
    """Print a scenario's metrics."""
    cameras = [each for each in every if each is not None]
    many = [each for each in cameras if each.markings >= MANY]
    print(
        f"{scenario}: {len(cameras)} cameras, {len(every) - len(cameras)} refused, "
        f"{sum(each.refined for each in cameras)} with lines"
    )
    for label, some in (("all", cameras), (f"{MANY} markings or more", many)):
        if some:
            print(
                f"  ground, {label} ({len(some)}): {ground(some, 0)} -> {ground(some, 1)} "
                "(median / 95 %)"
            )
    seeing = [each for each in cameras if len(each.ground[0])]
    gains = np.array([np.median(each.ground[0]) / np.median(each.ground[1]) for each in seeing])
    print(f"  lines help {np.mean(gains >= 3.0):.2f} of {len(gains)} cameras three times or more")
    wrong = sum(len(each.wrong) for each in cameras)
    named = sum(len(each.named) for each in cameras)
    right = sum(len(each.wrong & each.named) for each in cameras)
    print(f"  wrong clicks: {right} of {wrong} named, {named - right} others named")
    print(f"  asks for a look: {np.mean([each.weak for each in cameras]):.2f} of the cameras")
    for stage, label in enumerate(("from clicks", "with lines")):
        held = [np.mean([each.region[stage] < share for each in cameras]) for share in SHARES]
        wanted = " / ".join(f"{100.0 * share:g}" for share in SHARES)
        print(f"  regions of {wanted} %, {label}: " + " / ".join(f"{100 * h:.1f}" for h in held))
    sys.stdout.flush()


def main() -> None:
    """Print one block per scenario."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "scenarios", nargs="*", default=["match", "penalty-box", "sparse-corner"], metavar="NAME"
    )
    parser.add_argument("--surveys", type=int, default=19)
    parser.add_argument("--first", type=int, default=0, help="seed of the first survey")
    options = parser.parse_args()
    for scenario in options.scenarios:
        done: list[Outcome | None] = []
        for each in outcomes(scenario, range(options.first, options.first + options.surveys)):
            done.append(each)
            print(f"\r{len(done)} cameras", end="", file=sys.stderr, flush=True)
        print("\r" + " " * 20, end="\r", file=sys.stderr, flush=True)
        tell(scenario, done)


if __name__ == "__main__":
    main()
