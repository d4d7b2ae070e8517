"""Detectors, pose nets and landmarks on images: labelled real stills, and fine-tuning."""

from __future__ import annotations

import json
import os
import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from common import fetch_file, read_changes, read_image, run_worldpose, tell
from registry import DATA, SET, Table, Tables, benchmark, integer, option
from yolo_labels import read_yolo_labels

from data_contracts.arrays import Flags, Floats
from worldpose.detection.interfaces import People
from worldpose.detection.models import (
    load_bundled_detector,
    load_bundled_pose,
    load_detectors,
    load_pose,
)
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import fuse
from worldpose.detection.views import as_frame_detector
from worldpose.training.fine_tuning import split
from worldpose.training.labels import (
    LabelledPicture,
    PictureCache,
    read_labels,
    read_picture,
    write_labels,
)
from worldpose.training.metrics import (
    average_precision,
    detect_labelled,
    judge_boxes,
    score_keypoints,
)
from worldpose.training.settings import FineTuningSettings

LABELS = Path(__file__).parents[1] / "tests" / "real" / "stills" / "labels.json"

NARYA = (1820, 1024)
"""Width, height [px] of narya's still, which is squeezed to a square there."""

_HOMOGRAPHY = ("b1gb4dw0lf/homography-offside", "93cf231b3f568c8396a1ca0e7b6f80287c20b00b")
_OFFSIDES = ("off1", "off2", "off4", "off5", "off6", "off8", "nooff1", "hardoff1")
STILLS: dict[str, tuple[str, str, str]] = {
    "messi.png": (
        *("mguti97/PnLCalib", "8c87391d6f4ea40c5e4d65e61529916c7a49ce62"),
        "examples/messi_sample.png",
    ),
    "16.jpg": ("lood339/SCCvSD", "6bcb2f5bce2b69d4ea39949a59a032be44326edc", "data/16.jpg"),
    "13.jpg": ("nihal111/hawk_eye", "1fce410943a430b986be6a978504940a73e4a70f", "code/13.jpg"),
    "narya.png": (
        *("DonsetPG/narya", "a26438e9dae091e016813f675d2f37dbcbe6c84d"),
        "test_image.jpg",
    ),
    **{f"{name}.jpg": (*_HOMOGRAPHY, f"images/{name}.jpg") for name in _OFFSIDES},
}
"""Repository, commit and path of each still."""

CLASSES = ((0.0, np.inf), (0.0, 45.0), (45.0, 70.0), (70.0, np.inf))
"""Classes of people's heights [px]."""


MARGIN_PX = 4.0
"""Feet this near to the outline of the pitch are on it [px]."""

PARTS = {"train": "_1st_", "test": "_2nd_", "all": ""}
"""Text in the names of the images of each part."""


RECIPE = Path(__file__).parents[1] / "infra" / "embedded_detector"


@benchmark(
    "stills",
    "detectors and pose nets on twelve real stills that were labelled by eye",
    DATA,
    option("--fetch", action="store_true", help="get the stills first, into DATA/stills"),
    option("--detector", action="append"),
    option("--pose"),
    SET,
)
def score_detectors(options: Namespace) -> Tables:
    """Stills of football matches from public repositories, at fixed commits.

    The labels (tests/real/stills/labels.json) have boxes of all people at the pitch, and twelve
    joints of some, drawn on enlargements without help of a detector. Recall and precision are those
    at the detection stage's score threshold: on the pitch alone, where boxes with feet outside of
    it do not count, as a calibrated camera rejects them, and in the whole image, where every
    spectator counts as false. PCK is that of joints in the labelled boxes (a fifth of the torso).
    Detectors that take views of a fixed size see tiles, as in the stage.
    """
    if options.fetch:
        fetch_stills(options.data)
    changes = read_changes(options.settings)
    changes |= {"detector": tuple(options.detector)} if options.detector else {}
    changes |= {"pose": options.pose} if options.pose else {}
    settings, file = DetectionSettings.model_validate(changes), options.data / "stills/labels.json"
    stills, outlines = read_labels(file), pitch_outlines(file)
    found = detect(stills, settings)
    on_pitch, labelled = keep_pitch(found, stills, outlines)
    cases = [("whole image", found, stills)]
    for low, high in CLASSES:
        cases.append(
            (f"on the pitch, {low:g} to {high:g} px", on_pitch, limit_heights(labelled, low, high))
        )
    rows = []
    for name, people, pictures in cases:
        asked = sum(int((~still.ignored).sum()) for still in pictures)
        values = score_boxes(people, pictures, settings.high_score_threshold)
        rows.append([name, asked, *values.values()])
    pck = score_keypoints(load_pose(settings), stills, PictureCache(1 << 28)).pck
    return {
        "boxes": Table("boxes", ["where", "people", "recall", "precision", "AP50"], rows),
        "joints": Table("joints in labelled boxes", ["of", "PCK"], [["stills", pck]]),
    }


def fetch_stills(data: Path) -> None:
    """Write the stills and their labels to `data/stills`."""
    out = data / "stills"
    out.mkdir(parents=True, exist_ok=True)
    for name, where in STILLS.items():
        content = fetch_file(data / "stills_repositories", *where)
        (out / name).write_bytes(content)
        if name == "narya.png":
            wide = cv2.resize(read_image(content), NARYA, interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(out / name), wide)
    (out / "labels.json").write_bytes(LABELS.read_bytes())


def detect(stills: Sequence[LabelledPicture], settings: DetectionSettings) -> list[People]:
    """Return the people that the detectors see in each still, as the stage asks them."""
    detectors = [as_frame_detector(each, settings) for each in load_detectors(settings)]
    cache = PictureCache(1 << 28)
    return [
        fuse([each.detect([cache[still.path]])[0] for each in detectors], settings.nms_iou)
        for still in stills
    ]


def pitch_outlines(labels: Path) -> dict[str, Floats]:
    """Return the outline of the pitch (points, 2) [px] in each image of the label file."""
    images = json.loads(labels.read_text(encoding="utf-8"))["images"]
    return {image["file_name"]: np.array(image["pitch"], dtype=np.float32) for image in images}


def feet_inside(boxes: Floats, outline: Floats) -> Flags:
    """Return whether the middle of each box's lower edge is within the outline (boxes,)."""
    feet = np.stack([boxes[:, [0, 2]].mean(axis=1), boxes[:, 3]], axis=1)
    contour = np.asarray(outline, dtype=np.float32)[:, None]
    off = [cv2.pointPolygonTest(contour, (float(x), float(y)), True) for x, y in feet]
    return np.array(off) >= -MARGIN_PX


def keep_pitch(
    found: Sequence[People], stills: Sequence[LabelledPicture], outlines: dict[str, Floats]
) -> tuple[list[People], list[LabelledPicture]]:
    """Return boxes with their feet on the pitch, and stills whose other people are ignored."""
    people, labelled = [], []
    for each, still in zip(found, stills, strict=True):
        outline = outlines[still.path.name]
        on = feet_inside(each.boxes, outline)
        people.append(each.select(on))
        off = ~feet_inside(still.boxes, outline)
        labelled.append(replace(still, ignored=still.ignored | off))
    return people, labelled


def score_boxes(
    found: Sequence[People], stills: Sequence[LabelledPicture], threshold: float
) -> dict[str, float]:
    """Return recall and precision [1] at a score threshold, and AP50 [1]."""
    hits = asked = boxes = 0
    for people, still in zip(found, stills, strict=True):
        sure = people.scores >= threshold
        _, right = judge_boxes(people.select(sure), still)
        hits, boxes = hits + int(right.sum()), boxes + len(right)
        asked += int((~still.ignored).sum())
    return {
        "recall": hits / asked if asked else np.nan,
        "precision": hits / boxes if boxes else np.nan,
        "ap50": average_precision(found, stills),
    }


def limit_heights(
    stills: Sequence[LabelledPicture], low: float, high: float
) -> list[LabelledPicture]:
    """Return the stills with people of other heights ignored."""
    tall = [still.boxes[:, 3] - still.boxes[:, 1] for still in stills]
    return [
        replace(still, ignored=still.ignored | (height < low) | (height >= high))
        for still, height in zip(stills, tall, strict=True)
    ]


@benchmark(
    "panorama_people",
    "AP50 of person detectors on labelled stills of small people",
    DATA,
    option("--part", choices=tuple(PARTS), default="all", help="half of the match"),
    option("--stills", type=int, help="number of them, evenly over the names"),
    option("--detector", action="append"),
    SET,
)
def score_small_people(options: Namespace) -> Tables:
    """DATA holds `panorama_people`: images with a YOLO label file each; class 0 is a person.

    AP50 is COCO's, of all boxes, with precision integrated at every step of recall. All images look
    alike, so a split must be by time. The time is processor time of a still, decoding included.
    """
    changes = read_changes(options.settings)
    changes |= {"detector": tuple(options.detector)} if options.detector else {}
    settings = DetectionSettings.model_validate(changes)
    found = measure(options.data / "panorama_people", settings, options.stills, options.part)
    row = [", ".join(settings.detector), *found.values()]
    columns = ["detector", "AP50", "stills", "people", "time [ms]"]
    return {"people": Table(f"part {options.part}", columns, [row])}


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
    detectors = [as_frame_detector(each, settings) for each in load_detectors(settings)]
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


@benchmark(
    "finetuning",
    "gain by `worldpose finetune` on footage that the shipped nets do not know",
    option("folder", type=Path),
    integer("scenes", 25),
    option("--net", action="append", choices=("people", "keypoints")),
    SET,
)
def score_finetuning(options: Namespace) -> Tables:
    """Rendered into FOLDER, once: scenes of eight images that training does not have.

    Shirts with sashes and chequers, fog throughout and people of 34 to 48 px; labels are the truth,
    like those of a careful reviewer. Then the command line fine-tunes both nets, with settings of
    `training` from `--set`. AP50 of boxes and PCK of keypoints are of the images outside training
    and selection; last AP50 of the boxes that stage `detection` stores, which depend on both nets.
    """
    labels, rows = rendered_labels(options.folder, options.scenes), []
    project, files = options.folder / "project", {}
    for net in options.net or ("people", "keypoints"):
        begin = os.times()
        words = [word for setting in options.settings for word in ("--set", setting)]
        asked = ("finetune", labels, "--project", project, "--net", net, "--json", *words)
        made = json.loads(run_worldpose(*asked))["versions"][0]
        spent = os.times()
        seconds = spent.children_user - begin.children_user
        seconds += spent.children_system - begin.children_system
        files[net] = project / "detectors" / made["file"]
        numbers = [made["before"], made["after"], made["steps"], seconds / 60.0]
        rows.append([f"{net}, {made['figure']}", *numbers])
    both = [stored_ap50(labels, each) for each in ({}, files)]
    rows.append(["stored boxes, ap50", *both, None, None])
    columns = ["net", "before", "after", "steps", "CPU [min]"]
    return {"nets": Table("held-out images", columns, rows)}


def stored_ap50(labels: Path, files: dict[str, Path]) -> float:
    """Return AP50 of the boxes that `detection` stores for held-out images with these nets."""
    held_out = split(read_labels(labels), FineTuningSettings())[2]
    detector, pose = (
        load_bundled_detector(files.get("people")),
        load_bundled_pose(files.get("keypoints")),
    )
    found = detect_labelled(detector, held_out, PictureCache(1 << 28), pose)
    return average_precision(found, held_out)


def rendered_labels(folder: Path, scenes: int) -> Path:
    """Return the labels of all scenes; render missing ones."""
    sys.path.insert(0, str(RECIPE))
    from scenes import SHIFTED, SIZE, read_set, render_set

    for line in render_set(folder / "shifted", SHIFTED, scenes):
        tell(line)
    labels = folder / "shifted" / "labels.json"
    write_labels(labels, read_set(folder / "shifted")[: 8 * scenes], SIZE)
    return labels
