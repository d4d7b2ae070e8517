"""What an iteration found out about detections, applied to them before the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Singles


@dataclass(frozen=True, eq=False)
class Feedback:
    """Results of the previous iteration for the detections in some frames.

    The index of a detection identifies it, but people who were redetected since took places behind
    the others: results for their indices are about earlier ones, and do not apply.

    Attributes:
        redetected: (frames, cameras, detections), people redetected since.
        rejected: (frames, cameras, earlier detections, 17), keypoints to leave out; None = none.
        shift: (frames, cameras, earlier detections, 17, 2) [px], systematic error to subtract; None
            = none.
        redetected_shift: (frames, cameras, detections, 17, 2) [px], the same of redetected people,
            0 for others; subtracted together with `shift`.
        hide_redetected: whether redetected people are left out.
    """

    redetected: Flags
    rejected: Flags | None = None
    shift: Singles | None = None
    redetected_shift: Singles | None = None
    hide_redetected: bool = False


def apply_feedback(name: str, values: Singles, feedback: Feedback) -> Singles:
    """Return one array of detections with the results of the previous iteration applied.

    Args:
        name: name of the array, as of `KeypointDetections.arrays`.
        values: (frames, cameras, detections, ...).
        feedback: results for the same frames.
    """
    values = values.copy()
    if name == "keypoints" and feedback.shift is not None:
        values -= align_results(feedback.shift, feedback.redetected)
        if feedback.redetected_shift is not None:
            values -= feedback.redetected_shift
    if name in ("keypoints", "confidence") and feedback.rejected is not None:
        values[align_results(feedback.rejected, feedback.redetected)] = np.nan
    if feedback.hide_redetected:
        values[feedback.redetected] = np.nan
    return values


def align_results(before: NDArray[Any], redetected: Flags) -> NDArray[Any]:
    """Return results for earlier detections by current ones; zero for new and redetected ones.

    They are (frames, cameras, earlier detections, ...), `redetected` (frames, cameras, detections)
    since.
    """
    out = np.zeros((*redetected.shape, *before.shape[3:]), dtype=before.dtype)
    both = min(redetected.shape[2], before.shape[2])
    out[:, :, :both] = before[:, :, :both]
    out[redetected] = 0
    return out
