"""Task of stage `ingest`: one camera's given calibration and 2D poses into the store."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.ingest import INGEST
from data_contracts.run import Work
from tasks.unit import unit_task
from worldpose.cameras import Camera
from worldpose.cameras.stored import camera_arrays
from worldpose.errors import InputError
from worldpose.ingest import read_match, read_unit
from worldpose.store import Store


@unit_task
def ingest(work: Work) -> str:
    """Publishes the observations, and the camera where it is given; returns the key."""
    unit = work.recipe.unit
    with Store.open(work.project).publishing(work) as result:
        match = read_match(Path(work.folder))
        observations, calibration = read_unit(match, unit)
        _require_registered(match.detections[unit], work)
        arrays: dict[str, NDArray[Any]] = dict(observations.arrays())
        if calibration is not None:
            arrays |= camera_arrays(Camera.from_calibration(calibration))
        result.write(
            INGEST,
            arrays=arrays,
            coordinates={"frame": observations.frame},
            attributes={"camera_id": unit},
        )
        result.figures["frames"] = observations.frame.size
        result.figures["detections"] = int(np.isfinite(observations.score).sum())
    return work.key


def _require_registered(path: Path, work: Work) -> None:
    """Refuse a file that is not, or no longer, the one that the work's key stands for."""
    if hashlib.sha256(path.read_bytes()).hexdigest() != work.recipe.sources["detections"]:
        raise InputError(
            str(path),
            expected="the file that was registered when the run began",
            found="other content",
            todo="Run again when nothing writes to the match folder.",
        )
