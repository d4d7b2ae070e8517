r"""Prints AP50 of person detectors on labelled stills of small people.

    python benchmarks/panorama_people.py DATA [--part test] [--detector embedded] [--stills N] \
        [--set NAME=VALUE]

DATA holds `panorama_people`: images with a YOLO label file each (`class x_center y_center width
height` or `class x y x y ...`, all relative; class 0 is a person). Images without any label are
left out. AP50 is COCO's, of all boxes, with precision integrated at every step of recall instead of
at 101 points. `--set` changes settings of `detection`, and `--detector` may come more than once,
for an ensemble. `--stills N` takes N images evenly over the names. All images look alike, so a
split must be by time: `--part train` is the first half of the match, `test` the second. The time is
processor time of a still, decoding included.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from worldpose.detection.interfaces import People
from worldpose.detection.models import load_detectors
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import fuse
from worldpose.training.labels import LabelledPicture, read_picture, read_yolo_labels
from worldpose.training.metrics import average_precision

PARTS = {"train": "_1st_", "test": "_2nd_", "all": ""}
"""Text in the names of the images of each part."""


def load_stills(folder: Path, count: int | None = None, part: str = "all") -> list[LabelledPicture]:
    """Return labelled stills of a part, `count` of them evenly over their names; None = all."""
    files = [
        file
        for file in sorted(folder.glob(f"*{PARTS[part]}*.jpg".replace("**", "*")))
        if file.with_suffix(".txt").is_file()
    ]
    files = [file for file in files if file.with_suffix(".txt").read_text().strip()]
    if count is not None:
        files = [
            files[i]
            for i in np.linspace(0, len(files) - 1, min(count, len(files))).round().astype(int)
        ]
    return [read_yolo_labels(file) for file in files]


def detect_people(stills: Sequence[LabelledPicture], settings: DetectionSettings) -> list[People]:
    """Return the boxes of all detectors in each still."""
    detectors = load_detectors(settings)
    found = []
    for still in stills:
        image = read_picture(still.path)
        found.append(fuse([each.detect([image])[0] for each in detectors], settings.nms_iou))
    return found


def measure(
    folder: Path, settings: DetectionSettings, count: int | None = None, part: str = "all"
) -> dict[str, float]:
    """Return AP50 [1], the numbers of stills and of people, and the time of a still [ms]."""
    begun = time.process_time()
    stills = load_stills(folder, count, part)
    ap50 = average_precision(detect_people(stills, settings), stills)
    return {
        "ap50": ap50,
        "stills": len(stills),
        "people": sum(len(still.boxes) for still in stills),
        "time": 1e3 * (time.process_time() - begun) / len(stills),
    }


def main() -> None:
    """Print one line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--detector", action="append")
    parser.add_argument("--part", choices=tuple(PARTS), default="all")
    parser.add_argument("--stills", type=int)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    options = parser.parse_args()
    changes: dict[str, object] = dict(each.split("=", 1) for each in options.set)
    if options.detector:
        changes["detector"] = tuple(options.detector)
    settings = DetectionSettings.model_validate(changes)
    result = measure(options.data / "panorama_people", settings, options.stills, options.part)
    print(
        f"AP50 {result['ap50']:.3f} of {result['people']} people in {result['stills']} stills "
        f"({', '.join(settings.detector)}), {result['time']:.0f} ms per still"
    )


if __name__ == "__main__":
    main()
