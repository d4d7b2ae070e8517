"""Cameras of single broadcast pictures from hand-drawn lines: accuracy against annotations.

    python benchmarks/pitch_lines.py DATA [--every 1] [--half 0|1]

DATA holds `wc14` (lines.json, homographies.json, calib_eval.py) and `sn22_lines` (lines.json): the
2014 World Cup pictures and a part of SoccerNet-Calibration 2022. No truth is used to fit; settings
were chosen on the even half (`--half 0`), the odd half is for reporting.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from data_contracts.pitch import PitchSpec
from worldpose.cameras import Camera
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration import (
    CameraPrior,
    StaticCalibration,
    StaticCalibrationSettings,
    calibrate,
)
from worldpose.static_calibration.soccernet import soccernet_markings

# The scorer's template is flat. Broadcast pictures are crops of a zoom lens whose middle wanders.
PITCH = PitchTemplate.from_spec(PitchSpec(crown=0.0))
BROADCAST = StaticCalibrationSettings(
    prior=CameraPrior(principal_point_spread=0.03), k3_gain=0.9
)
SETS = {"wc14": ("wc14", (1280, 720)), "sn22": ("sn22_lines", (960, 540))}
PIXELS = (5, 10, 20)


@dataclass
class Fitted:
    """One picture's camera, or why there is none."""

    calibration: StaticCalibration | None
    error: str
    seconds: float

    @property
    def residual(self) -> float:
        """What the picture is refused by: the worst drawn pixel [px], infinite without a camera."""
        if self.calibration is None:
            return np.inf
        return max(marking.worst for marking in self.calibration.report.drawn)


def load_scorer(folder: Path) -> ModuleType:
    """The scorer that lies beside the data."""
    spec = importlib.util.spec_from_file_location("calib_eval", folder / "wc14" / "calib_eval.py")
    scorer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(scorer)
    return scorer


def load_lines(folder: Path, name: str, half: int | None, every: int) -> dict[str, dict]:
    """Annotations of one set by picture."""
    lines = json.loads((folder / SETS[name][0] / "lines.json").read_text())
    keys = sorted(lines)
    keys = keys if half is None else keys[half::2]
    return {key: lines[key] for key in keys[::every]}


def fit(lines: dict, size: tuple[int, int], settings: StaticCalibrationSettings) -> Fitted:
    """The camera of one picture."""
    start = time.perf_counter()
    try:
        found = calibrate(PITCH, soccernet_markings(lines, size), size, settings=settings)
    except InputError as error:
        return Fitted(None, str(error), time.perf_counter() - start)
    return Fitted(found, "", time.perf_counter() - start)


def as_json(camera: Camera) -> dict:
    """A camera in the scorer's form."""
    (fx, fy), (cx, cy) = camera.focal, camera.principal_point
    return {
        "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "R": camera.cam_from_world.rotation,
        "t": camera.cam_from_world.translation,
        "k": camera.distortion,
    }


def jaccards(scorer: ModuleType, lines: dict, camera: Camera, size: tuple[int, int]) -> list[float]:
    """JaC at every pixel threshold."""
    shares = []
    for pixels in PIXELS:
        hit, extra, lost, _ = scorer.jaccard(lines, as_json(camera), np.array(size, float), pixels)
        shares.append(hit / max(hit + extra + lost, 1))
    return shares


def scored(scorer: ModuleType, lines: dict, fits: dict[str, Fitted], size: tuple) -> dict:
    """JaC of every picture that has a camera."""
    return {
        key: jaccards(scorer, lines[key], fitted.calibration.estimate.camera, size)
        for key, fitted in fits.items()
        if fitted.calibration is not None
    }


def left_out(
    scorer: ModuleType, lines: dict, size: tuple, settings: StaticCalibrationSettings
) -> np.ndarray:
    """Shares of markings that the camera of all others predicts, at every pixel threshold."""
    hits = []
    for drawn in lines.values():
        for name, points in drawn.items():
            others = {other: xy for other, xy in drawn.items() if other != name}
            found = fit(others, size, settings).calibration
            predicted = {}
            if found is not None:
                camera = as_json(found.estimate.camera)
                predicted = scorer.image_lines(camera, np.array(size, float))
            off = np.inf
            if name in predicted:
                pixels = np.array(points, float) * size
                off = scorer.to_polyline(pixels, predicted[name]).max()
            hits.append([off <= limit for limit in PIXELS])
    return 100.0 * np.mean(hits, axis=0)


def curve(scores: dict, fits: dict[str, Fitted]) -> list[tuple[float, np.ndarray]]:
    """Completeness [%] and JaC [%] as pictures are refused by their own residual, worst first."""
    order = sorted(scores, key=lambda key: fits[key].residual)
    points = []
    for share in (1.0, 0.995, 0.988, 0.97, 0.95, 0.9):
        kept = order[: min(round(share * len(fits)), len(order))]
        points.append(
            (100.0 * len(kept) / len(fits), 100.0 * np.mean([scores[k] for k in kept], 0))
        )
    return points


def overlap(scorer: ModuleType, folder: Path, lines: dict, size: tuple) -> tuple[float, float]:
    """Mean and median IoU of the seen part [%] of distortion-free fits, against homographies."""
    truth = json.loads((folder / "wc14" / "homographies.json").read_text())
    settings = BROADCAST.model_copy(update={"distortion": "none"})
    x, y = 105.0 / scorer.TEMPLATE_W, 68.0 / scorer.TEMPLATE_H
    world_from_template = np.array([[x, 0, -52.5], [0, -y, 34.0], [0, 0, 1]])
    shares = []
    for key, drawn in lines.items():
        found = fit(drawn, size, settings).calibration
        if found is None:
            shares.append(0.0)
            continue
        camera = as_json(found.estimate.camera)
        plane = np.column_stack([camera["R"][:, :2], camera["t"]])
        homography = np.array(camera["K"]) @ plane @ world_from_template
        shares.append(100.0 * scorer.iou_part(np.array(truth[key], float), homography, size))
    return float(np.mean(shares)), float(np.median(shares))


def main() -> None:
    """Prints every figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--half", type=int, choices=(0, 1), default=1)
    parser.add_argument("--every", type=int, default=1, help="every n-th picture only")
    given = parser.parse_args()
    scorer = load_scorer(given.data)
    for name, (_, size) in SETS.items():
        lines = load_lines(given.data, name, given.half, given.every)
        fits = {key: fit(drawn, size, BROADCAST) for key, drawn in lines.items()}
        scores = scored(scorer, lines, fits, size)
        seconds = np.median([fitted.seconds for fitted in fits.values()])
        print(f"{name}: {len(lines)} pictures, {1e3 * seconds:.0f} ms each (median)")
        for complete, values in curve(scores, fits):
            shown = " / ".join(f"{value:.1f}" for value in values)
            print(f"  completeness {complete:5.1f} %: JaC@5/10/20 {shown}")
        shown = " / ".join(f"{v:.1f}" for v in left_out(scorer, lines, size, BROADCAST))
        print(f"  a marking left out and predicted, @5/10/20: {shown}")
        if name == "wc14":
            mean, median = overlap(scorer, given.data, lines, size)
            print(f"  IoU part without distortion: mean {mean:.1f}, median {median:.1f}")
        worst = sorted(scores, key=lambda key: scores[key][0])[:10]
        print("  ten worst:", ", ".join(f"{key} ({scores[key][0]:.2f})" for key in worst))
        for key, fitted in fits.items():
            if fitted.error:
                print(f"  {key}: {fitted.error}")


if __name__ == "__main__":
    main()
