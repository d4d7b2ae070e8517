"""Scores of predicted joints against true ones, without any alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.evaluation import Evaluation
from data_contracts.records import Record
from worldpose.evaluation.limbs import correct_limbs, limb_ends
from worldpose.evaluation.matching import match_frame
from worldpose.evaluation.settings import EvaluationSettings
from worldpose.release import JointTracks


class PersonScore(Record):
    """How well one true person was found; an absent figure could not be computed."""

    person_id: int
    frames: int
    """Frames in which this person counts."""
    coverage: float | None = None
    """Share of those with a matched prediction [0..1]."""
    joint_coverage: float | None = None
    """Share of true joints that have a predicted joint [0..1]."""
    mpjpe_mm: float | None = None
    """Mean distance of matched joints without any alignment [mm]."""
    pcp3d: float | None = None
    """Share of correct limbs, missing limbs counted wrong [%]."""


def evaluate_joints(
    prediction: JointTracks,
    reference: JointTracks,
    settings: EvaluationSettings | None = None,
) -> tuple[Evaluation, tuple[PersonScore, ...]]:
    """Return scores over all frames of the reference, and per true person.

    Frames are paired by number: a reference frame that the prediction lacks is all missed, a
    predicted frame that the reference lacks is not looked at. Within a frame people are paired by
    `match_frame`; their ids play no part.

    Args:
        prediction: estimated joints.
        reference: true joints; with `views`, only what enough cameras saw counts.
        settings: gate, limb bound and what counts; the defaults if None.
    """
    settings = settings or EvaluationSettings()
    aligned, false_people = _aligned(prediction, reference, settings.match_gate)
    counts = np.isfinite(reference.joints[..., 0])
    if reference.views is not None:
        counts &= reference.views >= settings.min_views
    existing = np.isfinite(reference.joints[..., 0]).sum(-1)
    present = (existing > 0) & (counts.sum(-1) >= settings.min_joint_share * existing)
    counts &= present[..., None]

    true = np.where(counts[..., None], reference.joints, np.nan)
    error = np.linalg.norm(aligned - true, axis=-1)
    tally = _Tally(
        frames=present,
        matched=present & np.any(np.isfinite(aligned[..., 0]), axis=-1),
        joints=counts,
        found=np.isfinite(error),
        error=np.where(np.isfinite(error), error, 0.0),
        limbs=np.all(np.isfinite(limb_ends(true)), axis=(-1, -2)),
        correct=correct_limbs(aligned, true, settings.pcp_alpha),
    )
    frames = len(reference.frames)
    people = tuple(
        PersonScore(
            person_id=int(person_id),
            frames=int(present[:, index].sum()),
            **tally.scores((slice(None), index)),
        )
        for index, person_id in enumerate(reference.person_ids)
    )
    evaluation = Evaluation(
        **tally.scores((slice(None), slice(None))),
        false_persons_per_frame=false_people / frames if frames else None,
        persons=int(present.any(axis=0).sum()),
        frames=frames,
    )
    return evaluation, people


@dataclass(frozen=True, eq=False)
class _Tally:
    """What counts and what was right; first dimensions frames and true persons."""

    frames: NDArray[np.bool_]
    matched: NDArray[np.bool_]
    joints: NDArray[np.bool_]
    found: NDArray[np.bool_]
    error: NDArray[np.float64]
    limbs: NDArray[np.bool_]
    correct: NDArray[np.bool_]

    def scores(self, part: tuple[slice, slice | int]) -> dict[str, float | None]:
        """Figures over a part of the frames and persons."""
        return {
            "coverage": _ratio(self.matched[part].sum(), self.frames[part].sum()),
            "joint_coverage": _ratio(self.found[part].sum(), self.joints[part].sum()),
            "mpjpe_mm": _ratio(1000.0 * self.error[part].sum(), self.found[part].sum()),
            "pcp3d": _ratio(100.0 * self.correct[part].sum(), self.limbs[part].sum()),
        }


def _ratio(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


def _aligned(
    prediction: JointTracks, reference: JointTracks, gate: float
) -> tuple[NDArray[np.float64], int]:
    """Return the prediction in the frames and persons of the reference, and the left-over people.

    Left over are predicted people in a frame who match no true one, whether it counts or not.
    """
    aligned = np.full(reference.joints.shape, np.nan)
    exists = np.any(np.isfinite(prediction.joints[..., 0]), axis=-1)
    false_people = 0
    _, rows, reference_rows = np.intersect1d(
        prediction.frames, reference.frames, assume_unique=True, return_indices=True
    )
    for row, reference_row in zip(rows, reference_rows, strict=True):
        people = prediction.joints[row, exists[row]]
        match = match_frame(people, reference.joints[reference_row], gate)
        known = match >= 0
        aligned[reference_row, known] = people[match[known]]
        false_people += len(people) - int(known.sum())
    return aligned, false_people
