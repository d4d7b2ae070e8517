"""Fine-tuning task: train one net on reviewed labels, and record its new version."""

from __future__ import annotations

import hashlib
import logging
from datetime import UTC, datetime
from pathlib import Path

from prefect import task

from data_contracts.finetune import NetKind, NetVersion
from worldpose.detection.models import BUNDLED_WEIGHTS
from worldpose.training.labels import read_labels
from worldpose.training.settings import FineTuningSettings

LOG = logging.getLogger("worldpose.finetune")


@task(name="finetune", task_run_name="finetune {kind}", retries=1, persist_result=False)
def finetune(
    kind: NetKind,
    annotations: Path,
    pictures: Path | None,
    folder: Path,
    settings: FineTuningSettings,
    start: Path | None,
) -> NetVersion:
    """Train a net, write `<kind>-<fingerprint>.safetensors` and `.json`; return the record.

    A retry, or the same call after a kill, resumes from the last checkpoint. The annotations are
    COCO keypoints, of images in `pictures` or else beside them; `start` are the initial weights, if
    not the shipped ones.
    """
    from worldpose.training.fine_tuning import NET_METRICS, fine_tune

    labels = _digest(annotations)
    parent = start or BUNDLED_WEIGHTS[0 if kind == "people" else 1]
    folder.mkdir(parents=True, exist_ok=True)
    # The name prevents other trainings from resuming its checkpoint.
    about = f"{labels}{_digest(parent)}{settings.model_dump_json()}".encode()
    draft = folder / f"{kind}-draft-{hashlib.sha256(about).hexdigest()[:12]}.safetensors"
    result = fine_tune(
        kind,
        read_labels(annotations, pictures),
        draft,
        settings,
        start=start,
        progress=lambda line: LOG.info("%s: %s", kind, line),
    )
    fingerprint = _digest(draft)
    file = folder / f"{kind}-{fingerprint[:12]}.safetensors"
    draft.replace(file)
    version = NetVersion(
        net=kind,
        parent=_digest(parent),
        fingerprint=fingerprint,
        file=file.name,
        labels=labels,
        learned=len(result.learned),
        held_out=tuple(picture.path.name for picture in result.held_out),
        figure=NET_METRICS[kind],
        before=result.before,
        after=result.after,
        steps=result.steps,
        adopted=result.better,
        seed=settings.training.seed,
        trained_at=datetime.now(UTC),
    )
    record = version.model_dump_json(indent=2) + "\n"
    file.with_suffix(".json").write_text(record, encoding="utf-8")
    return version


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
