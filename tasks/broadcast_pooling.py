"""Task of stage `broadcast_pooling`: one clip's camera at the pooled position of its clips."""

from __future__ import annotations

from typing import Any

from data_contracts.broadcast_pooling import BROADCAST_POOLING
from data_contracts.work import Work
from tasks.unit import open_input, unit_task
from worldpose.broadcast_calibration.uncertainty import (
    drawn_to,
    moving_arrays,
    moving_from_arrays,
    pool_centers,
)
from worldpose.store.store import Store


@unit_task
def broadcast_pooling(work: Work) -> str:
    """Publish the clip's camera, unchanged if the clips disagree; return the key."""
    store, unit = Store.open(work.project), work.recipe.unit
    sources: dict[str, Any] = work.recipe.sources
    clips: list[str] = sources["clips"]
    results = {clip: open_input(store, work, f"broadcast_calibration/{clip}") for clip in clips}
    places = {
        clip: (result["center"].values, result["clip_covariance"].values[:3, :3])
        for clip, result in results.items()
    }
    everybody = pool_centers(*zip(*places.values(), strict=True))
    own = {str(name): array.values for name, array in results[unit].data_vars.items()}
    camera, uncertainty = moving_from_arrays(own)
    if everybody.agree:
        camera, uncertainty = drawn_to(camera, uncertainty, everybody)
    with store.publish(work) as result:
        result.write(
            BROADCAST_POOLING,
            arrays=moving_arrays(camera, uncertainty),
            coordinates={"frame": results[unit]["frame"].values},
            attributes={
                "clip_id": unit,
                "clips": clips,
                "distance": [float(distance) for distance in everybody.distance],
                "agree": everybody.agree,
            },
        )
        result.figures["agree"] = float(everybody.agree)
    return work.key
