"""Fits the map of stored scores to probabilities, and measures it on images it was not fitted to.

    python infra/embedded_detector/score_map.py DATA FOLDER

DATA holds `panorama_people` (SoccerTrack v2, CC BY 4.0) and, to measure, `stills` (see
benchmarks/stills.py). FOLDER gets rendered scenes of the checking kind, from which no weight was
trained. The map is fitted to the first half of the panorama's match and to the renderings, which
weigh alike; the second half and the stills only measure. A stored box is right if it has an
intersection over union of a half with a person that no better box has. The static pair's labels
are not used: the bundled detector's own score selected them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from real_frames import read_panorama
from scenes import CHECKING, read_set, render_set
from scipy.optimize import minimize

from data_contracts.arrays import Flags, Floats
from worldpose.detection.interfaces import People, ScoreMap
from worldpose.detection.models import SHIPPED_SCORE_MAP, load_bundled_detector, load_bundled_pose
from worldpose.training.labels import LabelledPicture, PictureCache, read_labels
from worldpose.training.metrics import (
    average_precision,
    calibration_error,
    detect_labelled,
    judge_boxes,
)

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import stills
from yolo_labels import read_yolo_labels

SCENES = 10
"""Rendered scenes, of four images each."""
BINS = 8
"""Bins of equal size for the mean gap."""


def fit_score_map(sets: Sequence[tuple[Floats, Flags]]) -> ScoreMap:
    """Return the map with the largest likelihood of right and wrong boxes.

    Args:
        sets: scores (boxes,) and whether the boxes are right, by source; sources weigh alike.
    """
    score, right = (np.concatenate([each[k] for each in sets]) for k in (0, 1))
    weight = np.concatenate([np.full(len(each[0]), 1.0 / len(each[0])) for each in sets])
    logit = np.log(score) - np.log1p(-score)

    def cost(map_: Floats) -> tuple[float, Floats]:
        stated = map_[0] * logit + map_[1]
        wrong = weight * (1.0 / (1.0 + np.exp(-stated)) - right)
        loss = float(np.sum(weight * (np.logaddexp(0.0, stated) - right * stated)))
        return loss, np.array([wrong @ logit, wrong.sum()])

    found = minimize(cost, np.array([1.0, 0.0]), jac=True, method="BFGS")
    return ScoreMap(float(found.x[0]), float(found.x[1]))


def judge(found: Sequence[People], pictures: Sequence[LabelledPicture]) -> tuple[Floats, Flags]:
    """Return the scores of all boxes that count (boxes,), and whether they are right."""
    judged = [judge_boxes(*each) for each in zip(found, pictures, strict=True)]
    scores, right = zip(*judged, strict=True)
    return np.concatenate(scores), np.concatenate(right)


def main() -> None:
    """Print the map, and the gap between score and share of right boxes of every set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    for line in render_set(options.folder, CHECKING, SCENES, frames=1):
        print(line, flush=True)
    second = sorted((options.data / "panorama_people").glob("*_2nd_*.jpg"))
    sets = {
        "panorama, first half": read_panorama(options.data),
        "renderings": read_set(options.folder),
        "panorama, second half": [
            read_yolo_labels(file) for file in second if file.with_suffix(".txt").stat().st_size
        ],
    }
    labels = options.data / "stills" / "labels.json"
    if labels.is_file():
        sets["stills"] = read_labels(labels)
    detector, pose, cache = load_bundled_detector(), load_bundled_pose(), PictureCache(1 << 28)
    found = {name: detect_labelled(detector, each, cache, pose) for name, each in sets.items()}
    if "stills" in sets:
        outlines = stills.pitch_outlines(labels)
        found["stills"], sets["stills"] = stills.keep_pitch(
            found["stills"], sets["stills"], outlines
        )
    judged = {name: judge(found[name], each) for name, each in sets.items()}
    fitted = fit_score_map([judged["panorama, first half"], judged["renderings"]])
    print(f"fitted {fitted}; shipped {SHIPPED_SCORE_MAP}")
    print(
        f"{'':<24}{'boxes':>7}{'gap before':>12}{'fitted':>8}{'shipped':>9}{'AP50':>7}{'mapped':>8}"
    )
    for name, (scores, right) in judged.items():
        gaps = [
            calibration_error(each, right, BINS)
            for each in (scores, fitted.probability(scores), SHIPPED_SCORE_MAP.probability(scores))
        ]
        mapped = [People(each.boxes, fitted.probability(each.scores)) for each in found[name]]
        before, after = (average_precision(each, sets[name]) for each in (found[name], mapped))
        print(
            f"{name:<24}{len(scores):>7}{gaps[0]:>12.3f}{gaps[1]:>8.3f}{gaps[2]:>9.3f}"
            f"{before:>7.3f}{after:>8.3f}"
        )


if __name__ == "__main__":
    main()
