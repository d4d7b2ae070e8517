"""Cameras of single broadcast images from hand-drawn lines: accuracy against annotations.

    python benchmarks/pitch_lines.py DATA [--every 1] [--half 0|1] [--sheets FOLDER]

DATA holds `wc14` (lines.json, homographies.json, calib_eval.py) and `sn22_lines` (lines.json): the
2014 World Cup images and a part of SoccerNet-Calibration 2022. The fit uses no truth; settings were
tuned on the even half (`--half 0`), the odd half is for reporting. The scored lines are the fitted
ones: an annotation's slips count against the camera. The score with one marking left out cannot be
gained by overfitting.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from soccernet import soccernet_markings

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.settings import CameraPrior, StaticCalibrationSettings

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
FAR_OFF = BROADCAST.wrong_marking * BROADCAST.drawn_noise_px
CLEARLY_SEEN = 40.0  # pixels of a marking in the image that an annotator does not overlook


@dataclass
class Fitted:
    """One image's camera, or the reason why there is none."""

    calibration: StaticCalibration | None
    error: str
    seconds: float

    @property
    def residual(self) -> float:
        """Return the largest residual of a drawn pixel [px], infinite without a calibration."""
        if self.calibration is None:
            return np.inf
        return max(marking.worst for marking in self.calibration.report.drawn)


def load_scorer(folder: Path) -> ModuleType:
    """Return the scorer of the data set."""
    spec = importlib.util.spec_from_file_location("calib_eval", folder / "wc14" / "calib_eval.py")
    if spec is None or spec.loader is None:
        raise FileNotFoundError(f"no scorer in {folder}")
    scorer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(scorer)
    return scorer


def load_lines(folder: Path, name: str, half: int | None, every: int) -> dict[str, Lines]:
    """Return annotations of one set by image."""
    lines = json.loads((folder / SETS[name][0] / "lines.json").read_text())
    keys = sorted(lines)
    keys = keys if half is None else keys[half::2]
    return {key: lines[key] for key in keys[::every]}


def fit(lines: Lines, size: Size, settings: StaticCalibrationSettings) -> Fitted:
    """Return the camera of one image."""
    start = time.perf_counter()
    try:
        found = calibrate_camera(PITCH, soccernet_markings(lines, size), size, settings=settings)
    except InputError as error:
        return Fitted(None, str(error), time.perf_counter() - start)
    return Fitted(found, "", time.perf_counter() - start)


def as_json(camera: Camera) -> dict[str, Any]:
    """Return a camera in the scorer's form."""
    (fx, fy), (cx, cy) = camera.focal, camera.principal_point
    return {
        "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "R": camera.cam_from_world.rotation,
        "t": camera.cam_from_world.translation,
        "k": camera.distortion,
    }


def jaccards(scorer: ModuleType, lines: Lines, camera: Camera, size: Size) -> list[float]:
    """Return JaC at every pixel threshold."""
    shares = []
    for pixels in PIXELS:
        hit, extra, lost, _ = scorer.jaccard(lines, as_json(camera), np.array(size, float), pixels)
        shares.append(hit / max(hit + extra + lost, 1))
    return shares


def score_images(
    scorer: ModuleType, lines: dict[str, Lines], fits: dict[str, Fitted], size: Size
) -> dict[str, list[float]]:
    """Return the JaC of every calibrated image."""
    return {
        key: jaccards(scorer, lines[key], fitted.calibration.estimate.camera, size)
        for key, fitted in fits.items()
        if fitted.calibration is not None
    }


def left_out(
    scorer: ModuleType, lines: dict[str, Lines], size: Size, settings: StaticCalibrationSettings
) -> np.ndarray:
    """Return shares of markings predicted by the camera of all others, per pixel threshold."""
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
    return np.asarray(100.0 * np.mean(hits, axis=0))


def contradictions(
    scorer: ModuleType,
    lines: Lines,
    calibration: StaticCalibration,
    size: Size,
    limit: float,
    seen: float,
) -> list[str]:
    """Return disagreements between camera and annotation, in words.

    Args:
        scorer: projects the markings.
        lines: the annotation.
        calibration: of the image.
        size: width, height [px].
        limit: maximum distance of a drawn pixel [px].
        seen: length in the image from which a marking has to be drawn [px].
    """
    box = np.array(size, float)
    predicted = scorer.image_lines(as_json(calibration.estimate.camera), box)
    found = []
    for name, points in lines.items():
        if name not in predicted:
            found.append(f"{name} drawn where it is not seen")
            continue
        off = scorer.to_polyline(np.array(points, float) * box, predicted[name]).max()
        if off > limit:
            found.append(f"{name} {off:.0f} px off")
    for name, line in predicted.items():
        length = np.linalg.norm(np.diff(np.clip(line, 0.0, box), axis=0), axis=1).sum()
        if name not in lines and length > seen:
            found.append(f"{name} seen for {length:.0f} px, not drawn")
    return found


def refusal(
    scorer: ModuleType, lines: dict[str, Lines], fits: dict[str, Fitted], size: Size
) -> dict[str, tuple[float, float]]:
    """Return the share of markings with clear disagreement to the annotation, then the residual."""
    ranks = {}
    for key, fitted in fits.items():
        share = np.inf
        if fitted.calibration is not None:
            found = contradictions(
                scorer, lines[key], fitted.calibration, size, FAR_OFF, CLEARLY_SEEN
            )
            share = len(found) / len(lines[key])
        ranks[key] = (share, fitted.residual)
    return ranks


def curve(
    scores: dict[str, list[float]], refusal: Mapping[str, Any]
) -> list[tuple[float, np.ndarray]]:
    """Return completeness [%] and JaC [%] while images are refused by descending refusal score."""
    order = sorted(scores, key=lambda key: refusal[key])
    points = []
    for share in (1.0, 0.995, 0.988, 0.97, 0.95, 0.9):
        kept = order[: min(round(share * len(refusal)), len(order))]
        points.append(
            (100.0 * len(kept) / len(refusal), 100.0 * np.mean([scores[k] for k in kept], 0))
        )
    return points


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
        found = fit(drawn, size, settings).calibration
        if found is None:
            shares.append(0.0)
            continue
        camera = as_json(found.estimate.camera)
        plane = np.column_stack([camera["R"][:, :2], camera["t"]])
        homography = np.array(camera["K"]) @ plane @ world_from_template
        shares.append(100.0 * scorer.iou_part(np.array(truth[key], float), homography, size))
    return float(np.mean(shares)), float(np.median(shares))


def sheet(
    scorer: ModuleType, lines: dict[str, Lines], found: dict[str, StaticCalibration], size: Size
) -> np.ndarray:
    """Return images two to a row: green drawn, red only predicted, yellow large residuals."""
    box = np.array(size, float)
    tiles = []
    for key, calibration in found.items():
        tile = np.full((size[1], size[0], 3), 30, np.uint8)
        predicted = scorer.image_lines(as_json(calibration.estimate.camera), box)
        for name, line in predicted.items():
            color = (90, 200, 90) if name in lines[key] else (60, 60, 255)
            pixels = np.round(np.clip(line, -box, 2 * box)).astype(np.int32)
            cv2.polylines(tile, [pixels], False, color, 2, cv2.LINE_AA)
        for name, points in lines[key].items():
            pixels = np.array(points, float) * box
            near = name in predicted and scorer.to_polyline(pixels, predicted[name]).max() <= 5.0
            color, filled = ((255, 255, 255), 1) if near else ((0, 200, 255), -1)
            for pixel in np.round(pixels).astype(int):
                cv2.circle(tile, (int(pixel[0]), int(pixel[1])), 5, color, filled, cv2.LINE_AA)
        why = contradictions(scorer, lines[key], calibration, size, 5.0, 0.0)
        for row, text in enumerate([key, *why]):
            cv2.putText(tile, text, (10, 28 + 26 * row), 0, 0.7, (220, 220, 220), 1, cv2.LINE_AA)
        tiles.append(cv2.resize(tile, (800, 450), interpolation=cv2.INTER_AREA))
    tiles += [np.zeros_like(tiles[0])] * (len(tiles) % 2)
    return np.vstack([np.hstack(tiles[i : i + 2]) for i in range(0, len(tiles), 2)])


def main() -> None:
    """Print all metrics."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--half", type=int, choices=(0, 1), default=1)
    parser.add_argument("--every", type=int, default=1, help="every n-th picture only")
    parser.add_argument("--sheets", type=Path, help="folder for images of the ten worst")
    given = parser.parse_args()
    scorer = load_scorer(given.data)
    for name, (_, size) in SETS.items():
        lines = load_lines(given.data, name, given.half, given.every)
        fits = {key: fit(drawn, size, BROADCAST) for key, drawn in lines.items()}
        scores = score_images(scorer, lines, fits, size)
        seconds = np.median([fitted.seconds for fitted in fits.values()])
        print(f"{name}: {len(lines)} pictures, {1e3 * seconds:.0f} ms each (median)")
        residual: Mapping[str, Any] = {key: fitted.residual for key, fitted in fits.items()}
        refusals = {"worst pixel": residual, "contradictions": refusal(scorer, lines, fits, size)}
        for by, ranks in refusals.items():
            print(f"  refused by {by}: completeness, JaC@5/10/20 [%]")
            for complete, values in curve(scores, ranks):
                print(f"    {complete:5.1f}: {' / '.join(f'{value:.1f}' for value in values)}")
        shown = " / ".join(f"{v:.1f}" for v in left_out(scorer, lines, size, BROADCAST))
        print(f"  a marking left out and predicted, @5/10/20: {shown}")
        if name == "wc14":
            mean, median = overlap(scorer, given.data, lines, size)
            print(f"  IoU part without distortion: mean {mean:.1f}, median {median:.1f}")
        worst = {}
        for key in sorted(scores, key=lambda key: scores[key][0])[:10]:
            calibration = fits[key].calibration
            if calibration is None:
                continue
            worst[key] = calibration
            why = contradictions(scorer, lines[key], calibration, size, PIXELS[0], 0.0)
            print(f"  {key}: JaC@5 {scores[key][0]:.2f}; {'; '.join(why)}")
        if given.sheets:
            picture = sheet(scorer, lines, worst, size)
            cv2.imwrite(str(given.sheets / f"worst_{name}.png"), picture)
        for key, fitted in fits.items():
            if fitted.error:
                print(f"  {key}: {fitted.error}")


if __name__ == "__main__":
    main()
