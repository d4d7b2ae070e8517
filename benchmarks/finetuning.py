"""Prints the gain by `worldpose finetune` on labelled footage that the shipped nets do not know.

    python benchmarks/finetuning.py FOLDER [--scenes 25] [--net people] [--set NAME=VALUE ...]

Rendered into FOLDER, once: scenes of eight images with shirts outside the training data (sashes and
chequers), fog throughout and people of 34 to 48 px; labels are the truth, like those of a careful
reviewer. Then the command line fine-tunes both nets, with settings from `--set`. AP50 of boxes and
PCK of keypoints are of the images outside training and selection; last AP50 of the boxes that stage
`detection` stores, which depend on both nets.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from worldpose.detection.models import load_bundled_detector, load_bundled_pose
from worldpose.training.fine_tuning import split
from worldpose.training.labels import PictureCache, read_labels, write_labels
from worldpose.training.metrics import detect_labelled, score_people
from worldpose.training.settings import FineTuningSettings

WORLDPOSE = Path(sys.executable).with_name("worldpose")
RECIPE = Path(__file__).parents[1] / "infra" / "embedded_detector"


def main() -> None:
    """Render, fine-tune and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=25)
    parser.add_argument("--net", action="append", choices=("people", "keypoints"))
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="of training.*"
    )
    asked = parser.parse_args()
    labels = rendered_labels(asked.folder, asked.scenes)
    print(f"{'net':10}{'figure':>8}{'before':>8}{'after':>8}{'gain':>8}{'steps':>7}{'CPU min':>9}")
    project, files = asked.folder / "project", {}
    for net in asked.net or ("people", "keypoints"):
        version, seconds = fine_tuned(labels, project, net, asked.set)
        files[net] = project / "detectors" / version["file"]
        row = _row(net, version["figure"], version["before"], version["after"])
        print(f"{row}{version['steps']:7}{seconds / 60:9.1f}", flush=True)
    print(_row("both", "ap50", stored_ap50(labels, {}), stored_ap50(labels, files)))


def stored_ap50(labels: Path, files: dict[str, Path]) -> float:
    """Return AP50 of the boxes that `detection` stores for held-out images with these nets."""
    held_out = split(read_labels(labels), FineTuningSettings())[2]
    detector, pose = (
        load_bundled_detector(files.get("people")),
        load_bundled_pose(files.get("keypoints")),
    )
    return score_people(detect_labelled(detector, held_out, PictureCache(1 << 28), pose), held_out)[
        0
    ]


def _row(net: str, figure: str, before: float, after: float) -> str:
    return f"{net:10}{figure:>8}{before:8.3f}{after:8.3f}{after - before:+8.3f}"


def rendered_labels(folder: Path, scenes: int) -> Path:
    """Return the labels of all scenes; render missing ones."""
    sys.path.insert(0, str(RECIPE))
    from scenes import SHIFTED, SIZE, read_set, render_set

    for line in render_set(folder / "shifted", SHIFTED, scenes):
        print(line, file=sys.stderr)
    labels = folder / "shifted" / "labels.json"
    write_labels(labels, read_set(folder / "shifted")[: 8 * scenes], SIZE)
    return labels


def fine_tuned(
    labels: Path, project: Path, net: str, settings: list[str]
) -> tuple[dict[str, Any], float]:
    """Return the record of a net's new version, and its processor time [s]."""
    words = ["finetune", str(labels), "--project", str(project), "--net", net, "--json"]
    words += [word for setting in settings for word in ("--set", setting)]
    start = os.times()
    done = subprocess.run([WORLDPOSE, *words], stdout=subprocess.PIPE, text=True, check=True)
    end = os.times()
    seconds = end.children_user + end.children_system - start.children_user - start.children_system
    return json.loads(done.stdout)["versions"][0], seconds


if __name__ == "__main__":
    main()
