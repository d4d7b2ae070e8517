"""Metrics of predicted joints against true joints."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.evaluation import Evaluation
from data_contracts.match import MatchSpec
from data_contracts.records import Record
from worldpose.errors import InputError
from worldpose.evaluation.matching import (
    EvaluationSettings,
    identity_scores,
    joint_distances,
    match_people,
    match_tracks,
    select_frames,
    take_matched,
)
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import align
from worldpose.ingest.clock import row_rate

LIMBS: Final = {
    "left upper arm": ((5,), (7,)),
    "left lower arm": ((7,), (9,)),
    "right upper arm": ((6,), (8,)),
    "right lower arm": ((8,), (10,)),
    "left upper leg": ((11,), (13,)),
    "left lower leg": ((13,), (15,)),
    "right upper leg": ((12,), (14,)),
    "right lower leg": ((14,), (16,)),
    "torso": ((11, 12), (5, 6)),
    "head": ((5, 6), (3, 4)),
}
"""Each end is the mean of the named COCO-17 joints: torso from mid-hip to mid-shoulder, head from
mid-shoulder to the middle of the ears."""


def limb_ends(joints: Floats) -> Floats:
    """Return both ends (..., 10, 2, 3) [m] of the `LIMBS` of joints (..., 17, 3) [m], or NaN."""
    return np.stack(
        [
            np.stack([joints[..., list(end), :].mean(axis=-2) for end in ends], axis=-2)
            for ends in LIMBS.values()
        ],
        axis=-3,
    )


def correct_limbs(predicted: Floats, true: Floats, alpha: float) -> Flags:
    """Return a mask of correct limbs (..., 10): mean error of ends at most alpha times length.

    Joints are (..., 17, 3) [m]; a limb with a missing joint is wrong. It is the form used for Shelf
    and Campus: the mean of both errors is below the bound, not each as in Burenius et al., CVPR
    2013.
    """
    true_ends = limb_ends(true)
    error = np.linalg.norm(limb_ends(predicted) - true_ends, axis=-1).mean(axis=-1)
    length = np.linalg.norm(true_ends[..., 0, :] - true_ends[..., 1, :], axis=-1)
    return np.asarray(error <= alpha * length)


def paper_joints(joints: Floats) -> Floats:
    """Return the paper's joints (..., 14, 3) [m] from COCO-17 (..., 17, 3), NaN where missing."""
    neck = joints[..., 5:7, :].mean(axis=-2, keepdims=True)
    return np.concatenate([joints[..., :1, :], neck, joints[..., 5:, :]], axis=-2)


def challenge_joints(joints: Floats) -> Floats:
    """Return the joints (..., 13, 3) [m] that the challenge shares with COCO-17 (..., 17, 3)."""
    return np.concatenate([joints[..., :1, :], joints[..., 5:, :]], axis=-2)


def mid_hip(joints: Floats) -> Floats:
    """Return the middle of the hips (..., 3) [m] of COCO-17 joints, NaN if one is missing."""
    return np.asarray(joints[..., 11:13, :].mean(axis=-2))


@dataclass(frozen=True, eq=False)
class AlignedErrors:
    """Joint distances (frames, persons, 14) [m] of `paper_joints` once aligned, NaN if missing."""

    shared: Floats
    """One alignment for all people's whole trajectories."""
    per_person: Floats
    """One alignment for each person's whole trajectory."""
    per_frame: Floats
    """One alignment for each person in each frame."""
    scale: float
    """Scale of the shared alignment: true over predicted size; 1 if rigid, NaN without common
    joints."""


def aligned_errors(
    predicted: Floats, true: Floats, *, with_scale: bool, min_joints: int
) -> AlignedErrors:
    """Return joint errors after the three alignments of the paper.

    Both are (frames, persons, 17, 3) [m], in the order of the true people, NaN where missing or not
    counted. `with_scale` asks for similarities instead of rigid motions.
    """
    source, target = paper_joints(predicted), paper_joints(true)
    frames, persons, joints, _ = target.shape
    common = np.isfinite(source[..., 0]) & np.isfinite(target[..., 0])
    source = np.where(common[..., None], source, np.nan)

    everything = (frames * persons * joints, 3)
    shared = align(source.reshape(everything), target.reshape(everything), with_scale=with_scale)
    own_source, own_target = (
        np.swapaxes(points, 0, 1).reshape(persons, frames * joints, 3)
        for points in (source, target)
    )
    own = align(own_source, own_target, with_scale=with_scale)
    per_person = np.linalg.norm(own.apply(own_source) - own_target, axis=-1)
    enough = common.sum(-1) >= min_joints
    body = np.where(enough[..., None, None], source, np.nan)
    per_frame = align(body, target, with_scale=with_scale).apply(body) - target
    return AlignedErrors(
        shared=np.linalg.norm(
            shared.apply(source.reshape(everything)).reshape(target.shape) - target, axis=-1
        ),
        per_person=np.swapaxes(per_person.reshape(persons, frames, joints), 0, 1),
        per_frame=np.linalg.norm(per_frame, axis=-1),
        scale=float(shared.scale),
    )


def path_lengths(true: Floats, compared: Flags) -> Floats:
    """Return the length of every true person's path (persons,) [m].

    The path of the mid-hip of joints (frames, persons, 17, 3) [m] through the compared frames
    (frames, persons), with straight lines across gaps.
    """
    hips = mid_hip(true)
    used = compared & np.isfinite(hips[..., 0])
    lengths = np.zeros(true.shape[1])
    for person in range(true.shape[1]):
        steps = np.diff(hips[used[:, person], person], axis=0)
        lengths[person] = np.linalg.norm(steps, axis=-1).sum()
    return lengths


def drift_per_meter(errors: Floats, lengths: Floats, min_length: float) -> float | None:
    """Return the mean over people of mean error over path length [1], None without long paths.

    Errors are (frames, persons, joints) [m], NaN where missing; path lengths (persons,) [m]. The
    ratio of the published columns does not give the published drift: it is the mean of
    trajectories' ratios.
    """
    known = np.isfinite(errors)
    count = known.sum((0, 2))
    far = (lengths >= min_length) & (count > 0)
    if not far.any():
        return None
    total = np.where(known, errors, 0.0).sum((0, 2))
    return float((total[far] / count[far] / lengths[far]).mean())


def challenge_errors(predicted: Floats, true: Floats) -> tuple[Floats, Floats]:
    """Return global and local joint errors (frames, persons, 13) [m], without any alignment.

    Local errors are relative to the mid-hip of each side. Joints are (frames, persons, 17, 3) [m],
    those predicted in the order of the true people; NaN where missing.
    """
    offset = challenge_joints(predicted) - challenge_joints(true)
    roots = (mid_hip(predicted) - mid_hip(true))[..., None, :]
    return np.linalg.norm(offset, axis=-1), np.linalg.norm(offset - roots, axis=-1)


def acceleration_errors(predicted: Floats, true: Floats, frames: Integers, fps: float) -> Floats:
    """Return errors of joint acceleration (frames - 2, persons, 14) [m/s^2], NaN where unknown.

    Second differences of three successive frames at the minimum step, on `paper_joints`. Joints
    are (frames, persons, 17, 3) [m] as in `challenge_errors`; match frames (frames,) rise.
    """
    offset = paper_joints(predicted) - paper_joints(true)
    steps = np.diff(frames)
    if len(steps) < 2:
        return np.empty((0, *offset.shape[1:-1]))
    step = steps.min()
    regular = (steps[1:] == step) & (steps[:-1] == step)
    errors = np.linalg.norm(np.diff(offset, n=2, axis=0), axis=-1) * (fps / step) ** 2
    return np.where(regular[:, None, None], errors, np.nan)


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
    track_frames: int = 0
    """Frames with joints in the scores of whole tracks."""
    track_joints: int = 0
    """Joints behind `g_mpjpe_mm` and `per_person_g_mpjpe_mm`."""
    aligned_joints: int = 0
    """Joints behind `pa_mpjpe_mm`."""


def pool_people(
    people: Iterable[PersonScore], settings: EvaluationSettings | None = None
) -> Evaluation:
    """Return the scores of whole tracks over the people of several clips.

    Every joint counts once in the errors, every trajectory in the drift. Each clip has its own
    shared alignment. A score is None if nobody has it.
    """
    least = (settings or EvaluationSettings()).min_trajectory_m
    rows = [one.model_dump() for one in people]
    known = [row for row in rows if row["track_joints"]]
    far = [row for row in known if row["path_m"] >= least]

    def mean(name: str, weight: str) -> float | None:
        return _ratio(
            sum((r[name] or 0.0) * r[weight] for r in known), sum(r[weight] for r in known)
        )

    def drift(name: str) -> float | None:
        return _ratio(sum(0.1 * row[name] / row["path_m"] for row in far), len(far))

    return Evaluation(
        g_mpjpe_mm=mean("g_mpjpe_mm", "track_joints"),
        per_person_g_mpjpe_mm=mean("per_person_g_mpjpe_mm", "track_joints"),
        pa_mpjpe_mm=mean("pa_mpjpe_mm", "aligned_joints"),
        per_meter_drift_cm_per_m=drift("g_mpjpe_mm"),
        per_person_drift_cm_per_m=drift("per_person_g_mpjpe_mm"),
        track_coverage=_ratio(sum(r["track_frames"] for r in rows), sum(r["frames"] for r in rows)),
        persons=sum(row["frames"] > 0 for row in rows),
    )


def drop_views(reference: JointTracks, match: MatchSpec | None) -> JointTracks:
    """Return true joints for scores: without `views` if the match has no static camera.

    Of an unknown match, views of at most one camera everywhere are a broadcast camera's.
    """
    if reference.views is None:
        return reference
    alone = match is None and reference.views.max(initial=0) <= 1
    dropped = alone or (match is not None and not match.static_cameras)
    return replace(reference, views=None) if dropped else reference


def require_common(where: str, predicted: Integers, true: Integers) -> None:
    """Raise InputError if both sides have match frames, and none in common."""
    sides = predicted, true
    if all(map(len, sides)) and not len(np.intersect1d(*sides)):
        own, wanted = (f"{frames.min()} to {frames.max()}" for frames in sides)
        raise InputError(
            where,
            expected=f"match frames of the reference, which has some of {wanted}",
            found=f"{own}, none in common",
            todo="Name the prediction of the same clip, number both sides by match frames, or "
            "predict the labelled frames, with NaN where nobody was found.",
        )


def evaluate_joints(
    prediction: JointTracks,
    reference: JointTracks,
    settings: EvaluationSettings | None = None,
    *,
    fps: float | None = None,
    camera: Camera | None = None,
    boxes: Floats | None = None,
) -> tuple[Evaluation, tuple[PersonScore, ...]]:
    """Return metrics over all frames of the reference, and per true person.

    Frames are paired by number: people are missing in reference frames that the prediction lacks,
    and the function ignores predicted frames that the reference lacks. `match_people` pairs people
    per frame, without their ids; `merge_tracks` pairs trajectories.

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
        InputError: camera and reference have different numbers of frames, `fps` is not positive,
            or the prediction has none of the reference's frames.
    """
    settings = settings or EvaluationSettings()
    if fps is not None:
        row_rate("evaluate_joints", fps)
    require_common("frames of the prediction", prediction.frames, reference.frames)
    people = select_frames(prediction.joints, prediction.frames, reference.frames)
    distances = joint_distances(people, reference.joints)
    match = match_people(distances, settings.match_gate_m)
    counts = _counting_joints(reference, settings)
    present = np.asarray(counts.any(axis=-1))
    exists = np.asarray(np.isfinite(people[..., 0]).any(axis=-1))
    frames = len(reference.frames)
    # A prediction matched to a true person that does not count is no false positive.
    idle = np.zeros_like(exists)
    frame, person = np.nonzero((match >= 0) & ~present)
    idle[frame, match[frame, person]] = True

    true = np.where(counts[..., None], reference.joints, np.nan)
    scores_of = _tally(take_matched(people, match), true, present, settings.pcp_alpha)
    identity = identity_scores(distances, present, exists & ~idle, settings.match_gate_m)
    around = None if boxes is None else select_frames(boxes, prediction.frames, reference.frames)
    tracks = match_tracks(people, reference.joints, distances, match, camera, around, settings)
    figures, persons = _track_figures(
        take_matched(people, tracks), true, present, reference.frames, fps, settings
    )
    minutes = _minutes(reference.frames, fps)
    evaluation = Evaluation(
        **scores_of(slice(None)),
        **figures,
        false_persons_per_frame=_ratio(exists.sum() - (match >= 0).sum(), frames),
        **asdict(identity),
        switches_per_minute=(
            None if identity.switches is None or not minutes else identity.switches / minutes
        ),
        persons=int(present.any(axis=0).sum()),
        frames=frames,
    )
    scores = tuple(
        PersonScore(
            person_id=int(person_id),
            frames=int(present[:, index].sum()),
            **scores_of(index),
            **persons[index],
        )
        for index, person_id in enumerate(reference.person_ids)
    )
    return evaluation, scores


def _tally(
    predicted: Floats, true: Floats, present: Flags, alpha: float
) -> Callable[[slice | int], dict[str, float | None]]:
    """Compare matched people (frames, persons, 17, 3) [m]; return metrics by true persons."""
    error = np.linalg.norm(predicted - true, axis=-1)
    found = np.isfinite(error)
    matched = present & np.any(np.isfinite(predicted[..., 0]), axis=-1)
    joints = np.isfinite(true[..., 0])
    error = np.where(found, error, 0.0)
    limbs = np.all(np.isfinite(limb_ends(true)), axis=(-1, -2))
    correct = correct_limbs(predicted, true, alpha)

    def scores(who: slice | int) -> dict[str, float | None]:
        return {
            "coverage": _ratio(matched[:, who].sum(), present[:, who].sum()),
            "joint_coverage": _ratio(found[:, who].sum(), joints[:, who].sum()),
            "mpjpe_mm": _ratio(1000.0 * error[:, who].sum(), found[:, who].sum()),
            "pcp3d": _ratio(100.0 * correct[:, who].sum(), limbs[:, who].sum()),
        }

    return scores


def _ratio(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


def _mean(values: Floats, factor: float = 1.0) -> float | None:
    """Return the mean of finite values times a factor, None without any."""
    known = np.isfinite(values)
    return _ratio(factor * np.where(known, values, 0.0).sum(), int(known.sum()))


def _counting_joints(reference: JointTracks, settings: EvaluationSettings) -> Flags:
    """Return the mask of true joints that count (frames, persons, 17)."""
    exists = np.isfinite(reference.joints[..., 0])
    counts = exists
    if reference.views is not None:
        counts = exists & (reference.views >= settings.min_views)
    enough = counts.sum(-1) >= settings.min_joint_share * exists.sum(-1)
    return np.asarray(counts & enough[..., None])


def _minutes(frames: Integers, fps: float | None) -> float | None:
    if fps is None or not len(frames):
        return None
    return float(frames[-1] - frames[0] + 1) / fps / 60.0


def _track_figures(
    predicted: Floats,
    true: Floats,
    present: Flags,
    frames: Integers,
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
    for values, error, drift in (
        (free.shared, "g_mpjpe_mm", "per_meter_drift_cm_per_m"),
        (free.per_person, "per_person_g_mpjpe_mm", "per_person_drift_cm_per_m"),
        (free.per_frame, "pa_mpjpe_mm", ""),
        (rigid.shared, "g_mpjpe_rigid_mm", "per_meter_drift_rigid_cm_per_m"),
        (rigid.per_person, "per_person_g_mpjpe_rigid_mm", "per_person_drift_rigid_cm_per_m"),
        (rigid.per_frame, "pa_mpjpe_rigid_mm", ""),
    ):
        figures[error] = _mean(values, 1000.0)
        if drift:
            share = drift_per_meter(values, lengths, settings.min_trajectory_m)
            figures[drift] = None if share is None else 100.0 * share
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
            "track_frames": int(compared[:, index].sum()),
            "track_joints": int(np.isfinite(free.shared[:, index]).sum()),
            "aligned_joints": int(np.isfinite(free.per_frame[:, index]).sum()),
        }
        for index in range(true.shape[1])
    ]
    return figures, people
