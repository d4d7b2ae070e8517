"""Metrics of predicted joints against true joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.evaluation import Evaluation
from data_contracts.records import Record
from worldpose.evaluation.identity import identity_scores
from worldpose.evaluation.limbs import correct_limbs, limb_ends
from worldpose.evaluation.matching import joint_distances, match_people, taken
from worldpose.evaluation.settings import EvaluationSettings
from worldpose.evaluation.tracks import match_tracks
from worldpose.evaluation.trajectories import (
    acceleration_errors,
    aligned_errors,
    challenge_errors,
    drift_per_meter,
    path_lengths,
)
from worldpose.formats import JointTracks
from worldpose.geometry import Camera


class PersonScore(Record):
    """Metrics of one true person; None where a metric is undefined."""

    person_id: int
    frames: int
    """Frames in which this person counts."""
    coverage: float | None = None
    """Share of these frames with a matched prediction [0..1]."""
    joint_coverage: float | None = None
    """Share of true joints that have a predicted joint [0..1]."""
    mpjpe_mm: float | None = None
    """Mean distance of matched joints without any alignment [mm]."""
    pcp3d: float | None = None
    """Share of correct limbs, missing limbs counted wrong [%]."""
    g_mpjpe_mm: float | None = None
    """Mean joint distance after one alignment of all people's trajectories [mm]."""
    per_person_g_mpjpe_mm: float | None = None
    """Mean joint distance after the alignment of this person's trajectory [mm]."""
    pa_mpjpe_mm: float | None = None
    """Mean joint distance after alignment in each frame [mm]."""
    path_m: float | None = None
    """Length of the true path over the compared frames [m]."""


def evaluate_joints(
    prediction: JointTracks,
    reference: JointTracks,
    settings: EvaluationSettings | None = None,
    *,
    fps: float | None = None,
    camera: Camera | None = None,
    boxes: NDArray[np.float64] | None = None,
) -> tuple[Evaluation, tuple[PersonScore, ...]]:
    """Return metrics over all frames of the reference, and per true person.

    Frames are paired by number: people are missing in reference frames that the prediction lacks,
    and the function ignores predicted frames that the reference lacks. `match_people` pairs people
    per frame, without their ids; `merge_tracks` pairs trajectories (E3).

    Args:
        prediction: estimated joints.
        reference: true joints; with `views`, only joints seen by enough cameras count.
        settings: gates, limb bound and visibility thresholds; the defaults if None.
        fps: match frames per second [1/s]; without it there are no metrics over time.
        camera: camera to match tracks in by their boxes, single or one per frame of the reference;
            without it distances decide.
        boxes: (frames, persons, 4) x0 y0 x1 y1 [px] of the prediction in that image, if its joints
            do not project there; None = around the joints.

    Raises:
        InputError: camera and reference have different numbers of frames.
    """
    settings = settings or EvaluationSettings()
    people = _in_frames(prediction, reference.frames, prediction.joints)
    distances = joint_distances(people, reference.joints)
    match = match_people(distances, settings.match_gate)
    counts = _counting_joints(reference, settings)
    present = np.asarray(counts.any(axis=-1))
    exists = np.asarray(np.isfinite(people[..., 0]).any(axis=-1))
    frames = len(reference.frames)
    # A prediction matched to a true person that does not count is no false positive.
    idle = np.zeros_like(exists)
    frame, person = np.nonzero((match >= 0) & ~present)
    idle[frame, match[frame, person]] = True

    true = np.where(counts[..., None], reference.joints, np.nan)
    tally = _tally(taken(people, match), true, present, settings.pcp_alpha)
    identity = identity_scores(distances, present, exists & ~idle, settings.match_gate)
    around = None if boxes is None else _in_frames(prediction, reference.frames, boxes)
    tracks = match_tracks(people, reference.joints, distances, match, camera, around, settings)
    figures, persons = _track_figures(
        taken(people, tracks), true, present, reference.frames, fps, settings
    )
    minutes = _minutes(reference.frames, fps)
    evaluation = Evaluation(
        **tally.scores((slice(None), slice(None))),
        **figures,
        false_persons_per_frame=_ratio(exists.sum() - (match >= 0).sum(), frames),
        idf1=identity.idf1,
        hota=identity.hota,
        detection_accuracy=identity.detection_accuracy,
        association_accuracy=identity.association_accuracy,
        switches=identity.switches,
        switches_per_minute=(
            None if identity.switches is None or not minutes else identity.switches / minutes
        ),
        fragmentations=identity.fragmentations,
        persons=int(present.any(axis=0).sum()),
        frames=frames,
    )
    scores = tuple(
        PersonScore(
            person_id=int(person_id),
            frames=int(present[:, index].sum()),
            **tally.scores((slice(None), index)),
            **persons[index],
        )
        for index, person_id in enumerate(reference.person_ids)
    )
    return evaluation, scores


@dataclass(frozen=True, eq=False)
class _Tally:
    """Counts and errors of matched people; the first dimensions are frames and true persons."""

    frames: NDArray[np.bool_]
    matched: NDArray[np.bool_]
    joints: NDArray[np.bool_]
    found: NDArray[np.bool_]
    error: NDArray[np.float64]
    limbs: NDArray[np.bool_]
    correct: NDArray[np.bool_]

    def scores(self, part: tuple[slice, slice | int]) -> dict[str, float | None]:
        """Return metrics over a part of the frames and persons."""
        return {
            "coverage": _ratio(self.matched[part].sum(), self.frames[part].sum()),
            "joint_coverage": _ratio(self.found[part].sum(), self.joints[part].sum()),
            "mpjpe_mm": _ratio(1000.0 * self.error[part].sum(), self.found[part].sum()),
            "pcp3d": _ratio(100.0 * self.correct[part].sum(), self.limbs[part].sum()),
        }


def _tally(
    predicted: NDArray[np.float64],
    true: NDArray[np.float64],
    present: NDArray[np.bool_],
    alpha: float,
) -> _Tally:
    error = np.linalg.norm(predicted - true, axis=-1)
    return _Tally(
        frames=present,
        matched=present & np.any(np.isfinite(predicted[..., 0]), axis=-1),
        joints=np.isfinite(true[..., 0]),
        found=np.isfinite(error),
        error=np.where(np.isfinite(error), error, 0.0),
        limbs=np.all(np.isfinite(limb_ends(true)), axis=(-1, -2)),
        correct=correct_limbs(predicted, true, alpha),
    )


def _ratio(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


def _mean(values: NDArray[np.float64], factor: float = 1.0) -> float | None:
    """Return the mean of finite values times a factor, None without any."""
    known = np.isfinite(values)
    return _ratio(factor * np.where(known, values, 0.0).sum(), int(known.sum()))


def _in_frames(
    prediction: JointTracks, frames: NDArray[np.int64], rows: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return predicted rows at the given frames, NaN in frames that the prediction lacks."""
    people = np.full((len(frames), *rows.shape[1:]), np.nan)
    _, own, places = np.intersect1d(
        prediction.frames, frames, assume_unique=True, return_indices=True
    )
    people[places] = rows[own]
    return people


def _counting_joints(reference: JointTracks, settings: EvaluationSettings) -> NDArray[np.bool_]:
    """Return the mask of true joints that count (frames, persons, 17)."""
    exists = np.isfinite(reference.joints[..., 0])
    counts = exists
    if reference.views is not None:
        counts = counts & (reference.views >= settings.min_views)
    enough = counts.sum(-1) >= settings.min_joint_share * exists.sum(-1)
    return np.asarray(counts & enough[..., None])


def _minutes(frames: NDArray[np.int64], fps: float | None) -> float | None:
    if fps is None or not len(frames):
        return None
    return float(frames[-1] - frames[0] + 1) / fps / 60.0


def _track_figures(
    predicted: NDArray[np.float64],
    true: NDArray[np.float64],
    present: NDArray[np.bool_],
    frames: NDArray[np.int64],
    fps: float | None,
    settings: EvaluationSettings,
) -> tuple[dict[str, float | None], list[dict[str, float | None]]]:
    """Return the metrics of whole tracks, overall and per person."""
    free, rigid = (
        aligned_errors(
            predicted, true, with_scale=with_scale, min_joints=settings.min_aligned_joints
        )
        for with_scale in (True, False)
    )
    compared = np.asarray(np.isfinite(free.shared).any(-1))
    lengths = path_lengths(true, compared)
    figures: dict[str, float | None] = {}
    for errors, suffix in ((free, ""), (rigid, "_rigid")):
        figures[f"g_mpjpe{suffix}_mm"] = _mean(errors.shared, 1000.0)
        figures[f"per_person_g_mpjpe{suffix}_mm"] = _mean(errors.per_person, 1000.0)
        figures[f"pa_mpjpe{suffix}_mm"] = _mean(errors.per_frame, 1000.0)
        for name, values in (("meter", errors.shared), ("person", errors.per_person)):
            drift = drift_per_meter(values, lengths, settings.min_trajectory)
            figures[f"per_{name}_drift{suffix}_cm_per_m"] = None if drift is None else 100.0 * drift
    whole, local = challenge_errors(predicted, true)
    figures["challenge_global_m"], figures["challenge_local_m"] = _mean(whole), _mean(local)
    if figures["challenge_global_m"] is not None and figures["challenge_local_m"] is not None:
        figures["challenge_score"] = (
            figures["challenge_global_m"] + 5.0 * figures["challenge_local_m"]
        )
    if fps is not None:
        figures["acceleration_error_m_s2"] = _mean(
            acceleration_errors(predicted, true, frames, fps)
        )
    figures["g_scale"] = free.scale if np.isfinite(free.scale) else None
    figures["track_coverage"] = _ratio(compared.sum(), present.sum())
    people = [
        {
            "g_mpjpe_mm": _mean(free.shared[:, index], 1000.0),
            "per_person_g_mpjpe_mm": _mean(free.per_person[:, index], 1000.0),
            "pa_mpjpe_mm": _mean(free.per_frame[:, index], 1000.0),
            "path_m": float(lengths[index]) if compared[:, index].any() else None,
        }
        for index in range(true.shape[1])
    ]
    return figures, people
