"""Score of a challenge submission against true poses in the same layout."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body.keypoints import CHALLENGE15
from worldpose.errors import InputError
from worldpose.formats.challenge import PARQUET, read_submission

HIPS: Final = (CHALLENGE15.index("right_hip"), CHALLENGE15.index("left_hip"))
ALL: Final = "all clips"
"""Name of the row with all clips' joints together."""


class ChallengeScore(NamedTuple):
    """Mean errors of the 15 joints [m], without any alignment, and the poses compared."""

    global_m: float
    local_m: float
    poses: int

    def row(self) -> dict[str, float]:
        """Return the score, global plus five times local error [m], and what it is made of."""
        return {
            "challenge_score": self.global_m + 5.0 * self.local_m,
            "challenge_global_m": self.global_m,
            "challenge_local_m": self.local_m,
            "poses": self.poses,
        }


def score_submission(prediction: Path, reference: Path) -> dict[str, ChallengeScore]:
    """Return the scores by clip, and of `ALL` joints together.

    A person is the same row on both sides, as in the challenge, which gives the boxes. Predictions
    are a zip, npz or parquet; true poses are in the same layout, NaN without a person. InputError
    if a clip, person or pose of the reference is missing in the prediction.
    """
    true = read_submission(reference)
    found = read_submission(prediction)
    if not true:
        raise _refuse(f"{reference}", "clips", "none")
    errors: dict[str, tuple[Floats, Floats]] = {}
    for clip, places in true.items():
        where = f"{prediction}: {clip}"
        mine = found.get(clip)
        if mine is not None and PARQUET in (prediction.suffix, reference.suffix):
            mine, places = _pad_alike(mine, places)
        if mine is None or mine.shape != places.shape:
            shape = "no such clip" if mine is None else f"{mine.shape}"
            raise _refuse(where, f"(persons, frames, 15, 3) = {places.shape}", shape)
        known = np.asarray(np.isfinite(places).all(-1))
        missing = np.asarray((known & ~np.isfinite(mine).all(-1)).any(-1))
        if missing.any():
            person, frame = np.argwhere(missing)[0].tolist()
            row = f"{missing.sum()} without one, the first of person {person} in frame {frame}"
            raise _refuse(where, "a position for every joint of the reference", row)
        away = mine - places
        local = away - away[..., HIPS, :].mean(axis=-2, keepdims=True)
        rooted = known & known[..., HIPS].all(-1, keepdims=True)
        lengths = (np.linalg.norm(each, axis=-1) for each in (away, local))
        errors[clip] = next(lengths)[known], next(lengths)[rooted]
    parts = {clip: [each] for clip, each in errors.items()} | {ALL: list(errors.values())}
    scores = {}
    for name, several in parts.items():
        whole, local = (np.concatenate(column) for column in zip(*several, strict=True))
        if not len(local):
            raise _refuse(f"{reference}: {name}", "poses with both hips", "none")
        count = len(whole) // len(CHALLENGE15)
        scores[name] = ChallengeScore(float(whole.mean()), float(local.mean()), count)
    return scores


def _pad_alike(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Return joints with equal numbers of persons and frames: tables lack empty ones at the end."""
    shape = np.maximum(first.shape, second.shape)
    grown = []
    for joints in (first, second):
        more = [(0, extra) for extra in (shape - joints.shape).tolist()]
        grown.append(np.pad(joints, more, constant_values=np.nan))
    return grown[0], grown[1]


def _refuse(where: str, expected: str, found: str) -> InputError:
    todo = "Give every person of the challenge's boxes a pose, in the order of the boxes."
    return InputError(where, expected=expected, found=found, todo=todo)
