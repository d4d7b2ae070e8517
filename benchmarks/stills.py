r"""Scores person detectors and pose estimators on real stills that were labelled by eye.

    python benchmarks/stills.py fetch DATA
    python benchmarks/stills.py score DATA [--detector embedded ...] [--pose embedded] \
        [--set NAME=VALUE ...] [--plot FILE.png]

`fetch` gets twelve stills of football matches from public repositories, at fixed commits,
into DATA/stills, and puts the labels beside them (tests/real/stills/labels.json: boxes of all
people at the pitch, and twelve joints of some, drawn on enlargements without help of a detector).
`score` prints, per height of people, recall and precision at the detection stage's score threshold,
and AP50: on the pitch alone, where boxes with feet outside of the pitch do not count, as a
calibrated camera rejects them, and in the whole image, where every spectator counts as false. Then
follow PCK (a fifth of the torso) of joints in the labelled boxes, and how confidence agrees with
the share of right joints, and of right boxes as the stage stores them. Detectors that take views of
a fixed size see tiles, as in the stage.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

from data_contracts.arrays import Flags, Floats
from worldpose.detection.interfaces import People
from worldpose.detection.models import load_detectors, load_pose, load_score_map
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import fuse
from worldpose.detection.views import TiledDetector
from worldpose.training.labels import LabelledPicture, PictureCache, read_labels
from worldpose.training.metrics import (
    average_precision,
    calibration_error,
    correct_keypoints,
    judge_boxes,
    stored_people,
)

LABELS = Path(__file__).parents[1] / "tests" / "real" / "stills" / "labels.json"
GITHUB = "https://github.com/"
NARYA = (1820, 1024)
"""Width, height [px] of narya's still, which is squeezed to a square there."""
STILLS = {
    "messi.png": (
        "mguti97/PnLCalib",
        "8c87391d6f4ea40c5e4d65e61529916c7a49ce62",
        "examples/messi_sample.png",
    ),
    "16.jpg": (
        "lood339/SCCvSD",
        "6bcb2f5bce2b69d4ea39949a59a032be44326edc",
        "data/16.jpg",
    ),
    "13.jpg": (
        "nihal111/hawk_eye",
        "1fce410943a430b986be6a978504940a73e4a70f",
        "code/13.jpg",
    ),
    "narya.png": (
        "DonsetPG/narya",
        "a26438e9dae091e016813f675d2f37dbcbe6c84d",
        "test_image.jpg",
    ),
    **{
        f"{name}.jpg": (
            "b1gb4dw0lf/homography-offside",
            "93cf231b3f568c8396a1ca0e7b6f80287c20b00b",
            f"images/{name}.jpg",
        )
        for name in ("off1", "off2", "off4", "off5", "off6", "off8", "nooff1", "hardoff1")
    },
}
"""Repository, commit and path of each still."""
CLASSES = ((0.0, np.inf), (0.0, 45.0), (45.0, 70.0), (70.0, np.inf))
"""Classes of people's heights [px]."""
BINS = 8
MARGIN_PX = 4.0
"""Feet this near to the outline of the pitch are on it [px]."""


@dataclass(frozen=True)
class Reliability:
    """Confidence against the share that is right, in bins of equal size.

    Attributes:
        confidence: (bins,) mean in each bin [1].
        share: (bins,) that is right [1].
        gap: mean absolute difference, weighted by the size of the bins [1].
    """

    confidence: Floats
    share: Floats
    gap: float


def fetch(data: Path) -> None:
    """Write the stills and their labels to `data/stills`; git checks the content by its commit."""
    out = data / "stills"
    clones = data / "stills_repositories"
    out.mkdir(parents=True, exist_ok=True)
    for name, (repository, commit, path) in STILLS.items():
        clone = clones / repository.replace("/", "+")
        if not clone.is_dir():
            url = f"{GITHUB}{repository}"
            _git("clone", "--quiet", "--no-checkout", "--filter=blob:none", url, str(clone))
        content = _git("-C", str(clone), "cat-file", "blob", f"{commit}:{path}")
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise SystemExit(f"expected {path} of {repository} to be an image, found other bytes")
        if name == "narya.png":
            wide = cv2.resize(image, NARYA, interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(out / name), wide)
        else:
            (out / name).write_bytes(content)
    (out / "labels.json").write_bytes(LABELS.read_bytes())


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], check=True, stdout=subprocess.PIPE).stdout


def detect(stills: Sequence[LabelledPicture], settings: DetectionSettings) -> list[People]:
    """Return the people that the detectors see in each still, as the stage asks them."""
    detectors = [
        each
        if each.view_size is None
        else TiledDetector(each, settings.zooms, settings.view_overlap, settings.nms_iou)
        for each in load_detectors(settings)
    ]
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
        people.append(People(each.boxes[on], each.scores[on]))
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
        _, right, _ = judge_boxes(People(people.boxes[sure], people.scores[sure]), still)
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


def agreement(confidence: Floats, right: Flags) -> Reliability:
    """Return confidence against the share of right ones, in bins of equal size."""
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, BINS)
    said = np.array([confidence[part].mean() for part in parts])
    share = np.array([right[part].mean() for part in parts])
    return Reliability(said, share, calibration_error(confidence, right, BINS))


def store(
    found: Sequence[People], stills: Sequence[LabelledPicture], settings: DetectionSettings
) -> list[People]:
    """Return the people as the stage stores them, with the pose net's boxes and probabilities."""
    estimator, cache = load_pose(settings), PictureCache(1 << 28)
    score_map = load_score_map(settings)
    stored = [
        stored_people(people, cache[still.path], estimator, settings)
        for people, still in zip(found, stills, strict=True)
    ]
    if score_map is None:
        return stored
    return [People(each.boxes, score_map.probability(each.scores)) for each in stored]


def judge_joints(
    stills: Sequence[LabelledPicture], settings: DetectionSettings
) -> tuple[Floats, Floats]:
    """Return the confidence of labelled, visible joints and whether they are right (joints,)."""
    estimator, cache = load_pose(settings), PictureCache(1 << 28)
    confidence, right = [], []
    for still in stills:
        asked = (still.visible > 0).any(axis=1)
        if not asked.any():
            continue
        said = estimator.estimate(cache[still.path], still.boxes[asked])
        good = correct_keypoints(said.keypoints, still.keypoints[asked])
        counted = np.isfinite(good) & (still.visible[asked] == 2)
        confidence.append(np.nan_to_num(np.asarray(said.confidence, dtype=np.float64))[counted])
        right.append(good[counted])
    return np.concatenate(confidence), np.concatenate(right)


def plot_agreement(boxes: Reliability, joints: Reliability, file: Path) -> None:
    """Draw confidence against the share of right ones."""
    figure, axes = plt.subplots(figsize=(5, 5), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7")
    for found, name in ((boxes, "stored boxes on the pitch"), (joints, "joints")):
        axes.plot(found.confidence, found.share, "o-", label=f"{name}, mean gap {found.gap:.2f}")
    axes.set(xlabel="confidence", ylabel="share that is right", xlim=(0, 1), ylim=(0, 1))
    axes.legend()
    figure.savefig(file)
    plt.close(figure)


def score(data: Path, settings: DetectionSettings, plot: Path | None) -> None:
    """Print the tables."""
    folder = data / "stills"
    stills = read_labels(folder / "labels.json")
    found = detect(stills, settings)
    outlines = pitch_outlines(folder / "labels.json")
    on_pitch, labelled = keep_pitch(found, stills, outlines)
    threshold = settings.high_score_threshold
    print(f"{'boxes':<22}{'people':>8}{'recall':>8}{'precision':>11}{'AP50':>7}")
    rows = [
        ("whole image", found, stills),
        *(
            (f"on the pitch{_label(*each)}", on_pitch, limit_heights(labelled, *each))
            for each in CLASSES
        ),
    ]
    for name, people, pictures in rows:
        values = score_boxes(people, pictures, threshold)
        asked = sum(int((~still.ignored).sum()) for still in pictures)
        print(
            f"{name:<22}{asked:>8}{values['recall']:>8.3f}{values['precision']:>11.3f}"
            f"{values['ap50']:>7.3f}"
        )
    stored, _ = keep_pitch(store(found, stills, settings), stills, outlines)
    judged = [judge_boxes(*each)[:2] for each in zip(stored, labelled, strict=True)]
    boxes = agreement(
        np.concatenate([scores for scores, _ in judged]),
        np.concatenate([right for _, right in judged]),
    )
    confidence, right = judge_joints(stills, settings)
    joints = agreement(confidence, right > 0)
    print(f"\njoints: PCK {right.mean():.3f} of {len(right)} visible ones")
    for name, each in (("stored boxes", boxes), ("joints", joints)):
        print(f"\n{name}: mean gap {each.gap:.3f}\nconfidence  right")
        for said, share in zip(each.confidence, each.share, strict=True):
            print(f"{said:>10.2f}{share:>7.2f}")
    if plot is not None:
        plot_agreement(boxes, joints, plot)


def _label(low: float, high: float) -> str:
    if low == 0.0 and not np.isfinite(high):
        return ""
    if low == 0.0:
        return f", < {high:.0f} px"
    return f", >= {low:.0f} px" if not np.isfinite(high) else f", {low:.0f}-{high:.0f} px"


def main() -> None:
    """Fetch or score."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("fetch", "score"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--detector", action="append")
    parser.add_argument("--pose")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    if options.what == "fetch":
        fetch(options.data)
        return
    changes: dict[str, object] = dict(each.split("=", 1) for each in options.set)
    if options.detector:
        changes["detector"] = tuple(options.detector)
    if options.pose:
        changes["pose"] = options.pose
    score(options.data, DetectionSettings.model_validate(changes), options.plot)


if __name__ == "__main__":
    main()
