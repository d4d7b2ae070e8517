"""Cameras adjusted to people and markings, each accepted on its own (B1-B3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.building import (
    MARKINGS_SOLVER,
    KeypointNoise,
    camera_knowledge,
    markings_problem,
    measured_doubt,
    players_problem,
)
from worldpose.bundle_adjustment.clip import Clip, Observed, observe, with_learned_noise
from worldpose.bundle_adjustment.contradictions import Contradictions, find_contradictions
from worldpose.bundle_adjustment.frames import propose_frames
from worldpose.bundle_adjustment.guard import HeldOut, Verdict, held_out, verdict
from worldpose.bundle_adjustment.noise import measured_noise
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.bundle_adjustment.solving import Adjusted, solve
from worldpose.bundle_adjustment.survey import survey_response, with_shared_errors
from worldpose.cameras import Camera

_STRANGER: Final = "refused: it shows other people than the other cameras do under the same ids"
_ROUNDS: Final = 3
"""Solutions from which noise is learned; the third changes little."""


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """Cameras of a clip after adjustment.

    Attributes:
        clip: what was adjusted, with the noise of its detector in its confidences.
        cameras: (cameras,) batch; a camera whose change was refused is as it was.
        covariance: (cameras, 12, 12) of a step; as calibrated where the change was refused.
        accepted: (cameras,) bool.
        reasons: why each camera was accepted or refused.
        proposed: match frames that suit adjustment best.
        used: match frames that people were taken from.
        judged: match frames that judges were taken from.
        noise: of keypoints, as measured.
        verdict: judges' errors with calibrated and with changed cameras, also where refused.
        refused: (cameras,) batch as it would have been without the guard.
        iterations: of the last solution.
        converged: it came to rest.
        observations: keypoints that cameras were adjusted to [1].
    """

    clip: Clip
    cameras: Camera
    covariance: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    reasons: tuple[str, ...]
    proposed: NDArray[np.int64]
    used: NDArray[np.int64]
    judged: NDArray[np.int64]
    noise: KeypointNoise
    verdict: Verdict
    refused: Camera
    iterations: int
    converged: bool
    observations: int


def adjust_cameras(
    clip: Clip,
    settings: BundleAdjustmentSettings = BundleAdjustmentSettings(),  # noqa: B008
) -> BundleAdjustment:
    """Return the cameras that agree with markings and people, where people left out confirm it.

    People are split into groups. For each, cameras are adjusted without it, and the group judges:
    its keypoints in a camera against its joints from the other cameras, in frames that had no part
    either. A camera on which the judges' loss rises stands as it was, and the others are adjusted
    without it. At last the accepted ones are adjusted to everybody.

    Args:
        clip: calibrated cameras and triangulated people.
        settings: evidence, weights, acceptance.

    Note:
        B1-B3, trap 1; paper section "Bundle Adjustment".
    """
    proposed = propose_frames(clip, settings.frames, settings.frame_gap, settings.min_views)
    used = np.flatnonzero(np.isin(clip.frame, settings.chosen_frames))
    used = used if settings.chosen_frames else proposed
    judged = propose_frames(clip, settings.frames, settings.frame_gap, settings.min_views, used)
    judged = judged if len(judged) else used
    clip = with_learned_noise(clip, np.union1d(used, judged))
    adjuster = _Adjuster(clip, settings, used, judged)
    count = len(clip.clicks)
    everybody = adjuster.everybody
    if settings.evidence == "markings_and_players" and not len(everybody.points):
        return _nothing(clip, "nobody is seen by enough cameras", proposed, used, judged)
    if settings.evidence == "markings" and not any(c.inlier.any() for c in clip.clicks):
        return _nothing(clip, "nobody clicked a marking", proposed, used, judged)
    before, stranger = adjuster.before, adjuster.stranger
    standing = stranger.copy()
    first: Verdict | None = None
    while True:
        said = verdict(before, adjuster.judgement(standing))
        first = first or said
        with np.errstate(invalid="ignore"):
            confirmed = (said.judges >= settings.min_judges) & (said.loss[:, 1] <= said.loss[:, 0])
        if (confirmed | standing).all():
            break
        standing |= ~confirmed
        if (~standing).sum() < 2:
            standing[:] = True
            break
    freely = adjuster.solved(stranger)
    last = freely if standing.all() or (standing == stranger).all() else adjuster.solved(standing)
    own = adjuster.uncertainty(last)
    return BundleAdjustment(
        clip=clip,
        cameras=_where(~standing, last.cameras, clip.cameras),
        covariance=np.where(standing[:, None, None], clip.covariance, own),
        accepted=~standing,
        reasons=tuple(
            _STRANGER if stranger[c] else _reason(first, c, not standing[c], settings)
            for c in range(count)
        ),
        proposed=clip.frame[proposed],
        used=clip.frame[used],
        judged=clip.frame[judged],
        noise=adjuster.noise,
        verdict=first,
        refused=freely.cameras,
        iterations=last.iterations,
        converged=last.converged,
        observations=len(everybody.image),
    )


class _Adjuster:
    """Solves for all people or without one group, and lets groups judge."""

    def __init__(
        self,
        clip: Clip,
        settings: BundleAdjustmentSettings,
        used: NDArray[np.int64],
        judged: NDArray[np.int64],
    ) -> None:
        self.clip, self.settings, self.used, self.judged = clip, settings, used, judged
        people = np.ones(clip.detection_index.shape[2], dtype=np.bool_)
        self.everybody = observe(clip, used, people, clip.cameras, settings.min_views)
        self.noise = KeypointNoise()
        self.before = self.judgement(None)
        found = Contradictions.none(len(clip.clicks))
        if settings.evidence == "markings_and_players":
            found = find_contradictions(clip, judged, self.before, settings)
        self.stranger, self.doubt, self.offset = found.stranger, found.doubt, found.offset
        if settings.evidence == "markings_and_players" and len(self.everybody.points):
            self._learn()

    def _learn(self) -> None:
        """Find out how far keypoints are off, and whether calibration is as good as it says."""
        stranger, settings = self.stranger, self.settings
        for _ in range(_ROUNDS):
            observed = _only(self.everybody, ~stranger[self.everybody.camera_of])
            problem = players_problem(
                self.clip, observed, self.noise, stranger, settings, self.doubt
            )
            rough = solve(problem, settings.solver, self.offset)
            # Where the next solution begins: two or three steps are left to it.
            self.offset, self.everybody = rough.offset, observed._replace(points=rough.points)
            self.noise = measured_noise(
                rough.cameras, rough.points, self.everybody, settings.robust_scale
            )
        # Nobody is surer than he says he is. Once: repeated, one camera that shows somebody else
        # would free all the others step by step.
        self.doubt = self.doubt * np.maximum(measured_doubt(problem, rough), 1.0)

    def solved(self, standing: NDArray[np.bool_], without: int | None = None) -> Adjusted:
        """The adjustment to everybody, or to everybody but one group."""
        if self.settings.evidence == "markings":
            return solve(markings_problem(self.clip, standing, self.settings), MARKINGS_SOLVER)
        observed = self.everybody
        # A camera that stands as it was has no say: it would drag the others to its error.
        kept = ~standing[observed.camera_of]
        if without is not None:
            groups = self._groups(len(self.used))
            row = np.searchsorted(self.used, observed.frame_of)
            kept &= groups[row, observed.person_of] != without
        observed = _only(observed, kept)
        problem = players_problem(
            self.clip, observed, self.noise, standing, self.settings, self.doubt
        )
        return solve(problem, self.settings.solver, self.offset, covariance=without is None)

    def uncertainty(self, adjusted: Adjusted) -> NDArray[np.float64]:
        """The covariance (cameras, 12, 12) of adjusted cameras."""
        information, _ = camera_knowledge(self.clip.covariance, self.settings.given)
        doubt = self.doubt[:, None, None]
        response = survey_response(self.clip, self.settings.survey_error)
        return with_shared_errors(
            adjusted.camera_covariance, information / doubt, np.sqrt(doubt) * response
        )

    def judgement(self, standing: NDArray[np.bool_] | None) -> HeldOut:
        """Every group's errors with cameras adjusted without it; None = cameras as they were."""
        robust = self.settings.robust_scale
        groups = self._groups(len(self.judged))
        if standing is None or self.settings.evidence == "markings":
            cameras = self.clip.cameras if standing is None else self.solved(standing).cameras
            return held_out(self.clip, cameras, self.judged, groups >= 0, robust)
        loss = error = np.full((1, 1, 1, 1), np.nan)
        for group in np.unique(groups):
            cameras = self.solved(standing, without=group).cameras
            held = held_out(self.clip, cameras, self.judged, groups == group, robust)
            loss = np.where(np.isnan(loss), held.loss, loss)
            error = np.where(np.isnan(error), held.error, error)
        return HeldOut(loss, error)

    def _groups(self, frames: int) -> NDArray[np.int64]:
        """The group (frames, persons) of everybody; parts of the time where there is one person."""
        persons = self.clip.detection_index.shape[2]
        folds = self.settings.folds
        if persons > 1:
            return np.tile(np.arange(persons) % min(folds, persons), (frames, 1))
        return np.repeat((np.arange(frames) * folds // max(frames, 1))[:, None], persons, axis=1)


def _only(observed: Observed, kept: NDArray[np.bool_]) -> Observed:
    """The observations (n,) that are kept, and their points numbered anew.

    A point that is left with one of them tells nothing.
    """
    kept = kept & (
        np.bincount(observed.point_of[kept], minlength=len(observed.points))[observed.point_of] > 1
    )
    used, number = np.unique(observed.point_of[kept], return_inverse=True)
    rows = {name: getattr(observed, name)[kept] for name in Observed._fields if name != "points"}
    return Observed(points=observed.points[used], **(rows | {"point_of": number}))


def _where(changed: NDArray[np.bool_], new: Camera, old: Camera) -> Camera:
    """The batch of new cameras where they changed and of old ones elsewhere."""
    return Camera.stack([(new if take else old)[c] for c, take in enumerate(changed)])


def _reason(said: Verdict, c: int, accepted: bool, settings: BundleAdjustmentSettings) -> str:
    """Why a camera's change was accepted or refused, with the figures that decided."""
    judges = int(said.judges[c])
    if judges < settings.min_judges:
        return f"refused: {judges} left-out keypoints, {settings.min_judges} are asked for"
    before, after = said.loss[c]
    change = f"loss of {judges} left-out keypoints {before:.3f} to {after:.3f}"
    if accepted:
        return f"accepted: {change}"
    risen = "" if after > before else ", risen once other cameras were refused"
    return f"refused: {change}{risen}"


def _nothing(
    clip: Clip,
    reason: str,
    proposed: NDArray[np.int64],
    used: NDArray[np.int64],
    judged: NDArray[np.int64],
) -> BundleAdjustment:
    """The clip's cameras as they were, for a reason that holds for all of them."""
    count = len(clip.clicks)
    nan = np.full((count, 2), np.nan)
    return BundleAdjustment(
        clip=clip,
        cameras=clip.cameras,
        covariance=clip.covariance,
        accepted=np.zeros(count, dtype=np.bool_),
        reasons=(f"refused: {reason}",) * count,
        proposed=clip.frame[proposed],
        used=clip.frame[used],
        judged=clip.frame[judged],
        noise=KeypointNoise(),
        verdict=Verdict(np.zeros(count, dtype=np.int64), nan, nan),
        refused=clip.cameras,
        iterations=0,
        converged=True,
        observations=0,
    )
