"""Task of stage `ingest`: one camera's 2D poses into the store."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_contracts.ingest import INGEST
from data_contracts.run import Work
from tasks.unit import require_registered, unit_task
from worldpose.ingest import Observations, read_observations
from worldpose.store import Store


@unit_task
def ingest(work: Work) -> str:
    """Publishes the observations; returns the key."""
    with Store.open(work.project).publishing(work) as result:
        observations = _observations(work)
        result.write(
            INGEST,
            arrays=observations.arrays(),
            coordinates={"frame": observations.frame},
            attributes={"camera_id": work.recipe.unit},
        )
        result.figures["frames"] = observations.frame.size
        result.figures["detections"] = int(np.isfinite(observations.score).sum())
    return work.key


def _observations(work: Work) -> Observations:
    """The unit's people on match frames, from the very file that its key stands for.

    Raises:
        InputError: the file is not, or no longer, the one that was registered.
    """
    sources: dict[str, Any] = work.recipe.sources
    path = Path(work.folder) / sources["detections"]
    first = sources["first_frame"] + sources["offset_frames"]
    observations = read_observations(path, first, sources["frame_count"])
    require_registered(path, sources["detections_sha256"])
    return replace(observations, frame=observations.frame - sources["offset_frames"])
