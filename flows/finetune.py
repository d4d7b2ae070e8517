"""Fine-tuning flow: reviewed labels in, new versions of the embedded nets out.

Labels come from people: detections of chosen frames, corrected in review and exported as COCO
keypoints. A version is adopted only if it is better on held-out frames; adopted or not, it is kept
with its metrics, and later runs use the version that their settings name.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from prefect import flow

from data_contracts.finetune import NetKind, NetVersion
from tasks.finetune import finetune
from worldpose.training.labels import read_labels
from worldpose.training.settings import FineTuningSettings

FOLDER = "detectors"
"""Project folder with versions of nets, `<net>-<fingerprint>.safetensors`, and their records."""


@flow(name="finetune", validate_parameters=False)
def fine_tune_nets(
    annotations: Path,
    pictures: Path | None,
    folder: Path,
    nets: Sequence[NetKind],
    settings: FineTuningSettings,
    starts: dict[NetKind, Path],
) -> list[NetVersion]:
    """Train each net in turn, and return the records of their new versions.

    The images are in `pictures`, or beside the annotations; `starts` are initial weights, if not
    the shipped ones.
    """
    from worldpose.training.fine_tuning import split  # late: it imports torch

    labelled = read_labels(annotations, pictures)
    for kind in nets:  # refuses labels before the first training
        split(labelled, settings, kind)
    return [
        finetune(kind, annotations, pictures, folder, settings, starts.get(kind)) for kind in nets
    ]
