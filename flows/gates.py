"""Review gates: where a run waits for review, and the metric limits that require it.

A gate follows a stage and checks each of its results separately; `GATES` lists all gates. The
`Gatekeeper` of a run decides from verdicts, metrics and policy which results need review.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from pydantic import Field

from data_contracts.records import Record
from data_contracts.review import ReviewDecision, ReviewRequest
from data_contracts.run import GatePolicy, ResultManifest, WaitingUnit
from data_contracts.usability import UsableLimits
from flows.stage import Match
from worldpose.bundle_adjustment.settings import CHANCE
from worldpose.review.journal import Journal, last_decision, requests_by_id, say
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.store.store import Store

Figures = Mapping[str, float]


@dataclass(frozen=True)
class Gate:
    """Gate that requests a review.

    Attributes:
        stage: the stage that the gate follows, also the gate's name.
        question: the decision for the reviewer.
        limits: record of the largest metrics that `auto` lets pass.
        judged: maps a result's metrics to those that are compared with the limits.
        to_correct: what a person corrects after a rejection.
    """

    stage: str
    question: str
    limits: Record
    to_correct: str
    judged: Callable[[Figures], Figures] = lambda figures: figures

    def objections(self, figures: Figures) -> tuple[str, ...]:
        """Return a line for each metric beyond its limit; none if `auto` lets the result pass.

        A result without any metric, such as a given camera, passes: it was judged before the run. A
        metric that could not be computed is beyond every limit.
        """
        if not figures:
            return ()
        judged = self.judged(figures)
        lines = []
        for name, limit in self.limits:
            if name not in judged:
                lines.append(f"{name} could not be computed")
            elif exceeds(judged[name], limit):
                lines.append(_beyond(name, judged, limit))
        return tuple(lines)

    def excess(self, figures: Figures) -> float:
        """Return the relative excess of the worst metric [1]: 0 within, 1 at twice the limit.

        For a limit of zero it is the metric itself.
        """
        judged = self.judged(figures)
        beyond = [
            judged[name] / limit - 1.0 if limit else judged[name]
            for name, limit in self.limits
            if name in judged
        ]
        return max([0.0, *beyond])


def exceeds(value: float, limit: float) -> bool:
    """Return whether a metric exceeds a limit with the digits that the reason shows; NaN does."""
    return not float(f"{value:.4g}") <= float(f"{limit:.4g}")


def _beyond(name: str, judged: Figures, limit: float) -> str:
    """Return the line of a metric beyond its limit, with the parts `name.part` that are."""
    parts = [
        key.removeprefix(f"{name}.")
        for key, value in judged.items()
        if key.startswith(f"{name}.") and exceeds(value, limit)
    ]
    named = f" ({', '.join(parts)})" if parts else ""
    return f"{name} is {judged[name]:.4g}{named}, at most {limit:.4g} passes"


_CALIBRATION: Final = StaticCalibrationSettings()
_USABLE: Final = UsableLimits()


class CameraLimits(Record):
    """Metric limits of a calibrated static camera."""

    expected_ground_error_median_m: float = Field(default=_CALIBRATION.weak_median_m, ge=0)
    """Expected error on the pitch, median over the visible pitch [m]: the limit of which the
    calibration page warns. People correct the cameras later (`bundle_adjustment`)."""
    expected_ground_error_p95_m: float = Field(default=_CALIBRATION.weak_p95_m, ge=0)
    """The same at its 95th percentile [m]: the far side, where a pixel is 5 to 20 cm."""
    clicks_wrong: float = Field(default=0, ge=0)
    """Clicks that are outliers to the others [1]. A click at the wrong marking is one, and the
    annotator sees at once which click is wrong."""
    weak: float = Field(default=0, ge=0)
    """1 if the clicks leave a direction of the camera undetermined [1]."""


class PeopleLimits(Record):
    """Metric limits of the people found in a camera's clip (D6).

    Frames without an image are no question: nobody can correct them on a page. The verdict on the
    results names them.
    """

    empty_share: float = Field(default=0.5, ge=0)
    """Share of images without detections [1]. A camera can look away from play at times; one
    without people for half a clip is turned, dark or outside the detector's training data."""
    bridged_share: float = Field(default=0.25, ge=0)
    """Share of boxes interpolated between two processed frames [1]; at a quarter, the detector
    misses too many."""
    flicker_share: float = Field(default=0.10, ge=0)
    """Boxes of discarded short tracks per kept box [1]: false positives on turf, boards and
    crowd."""


class ConsistencyLimits(Record):
    """Limits of the cross-checks between static cameras; a left-out camera always needs review."""

    contradictions: float = Field(default=0, ge=0)
    """Cameras that contradict another with no evidence which is wrong [1]."""


class IdentityLimits(Record):
    """Metric limits of a clip's tracks."""

    undecided: float = Field(default=0, ge=0)
    """Joins of two tracks with ambiguous evidence [1]: a person decides these at once, and a
    wrong guess corrupts all that follows."""
    unmatched_share: float = Field(default=_USABLE.max_unusable_share, ge=0)
    """Share of detections without a track [1]. People beside the pitch are a quarter of them at a
    small ground, which nobody can correct: the verdict names them. At half, a clock or a camera is
    wrong, or the net finds people where none are."""
    mean_ray_distance_m: float = Field(default=_USABLE.max_ray_distance_m, ge=0)
    """Distance between the rays of matched detections [m]."""
    corrections_refused: float = Field(default=0, ge=0)
    """Identity corrections that do not fit these tracks [1]; the tracks lack these corrections."""


class JointLimits(Record):
    """Metric limits of a clip's triangulated joints."""

    standard_deviation_m: float = Field(default=_USABLE.max_standard_deviation_m, ge=0)
    """Root of the trace of a joint's covariance, median over joints [m]."""
    filled_share: float = Field(default=_USABLE.max_filled_share, ge=0)
    """Share of joints filled by the motion model alone [1]."""
    unhealthy_share: float = Field(default=0.05, ge=0)
    """Share of the clip in which a camera's keypoints depart from people, its images are missing,
    dark, bright or blurred; of the worst camera [1]."""


class AdjustmentLimits(Record):
    """Metric limits of adjusted cameras.

    The number of changes that held-out validation refused has no limit: accurate cameras need none.
    """

    held_out_error_after_px: float = Field(default=5.0, ge=0)
    """Median reprojection error of held-out people in the adjusted cameras [px]; 1.5 to 2.4 on
    simulated matches."""
    held_out_growth: float = Field(default=1.0, ge=0)
    """The same relative to before the adjustment [1]: above 1 the adjustment did harm."""


class ClipLimits(Record):
    """Metric limits of the bodies of a clip before release."""

    offset_rms_m: float = Field(default=_USABLE.max_body_offset_m, ge=0)
    """Offset of the detector's joints from the body's joints, along an axis [m]."""
    filled_share: float = Field(default=0.05, ge=0)
    """Share of bodies in frames without any joint of the person [1]."""
    held_out_certain_excess_m: float = Field(default=_USABLE.max_body_excess_m, ge=0)
    """Error of fitted joints beyond that of triangulated joints, of the worst joint group [m]."""


class BroadcastLimits(Record):
    """Metric limits of a clip's calibrated broadcast camera."""

    expected_error_median_px: float = Field(default=_USABLE.max_broadcast_error_px, ge=0)
    """Expected error of the pitch in the image, median over frames [px]."""
    weak: float = Field(default=0, ge=0)
    """1 if the clip's report asks for a check [1]."""


EXCESS: Final = "held_out_certain_excess_m"


def _in_3d(figures: Figures) -> Figures:
    """Pass absent metrics of people in 3D if no person is in 3D: the run says so, and why."""
    flat = figures.get("plane_people", 0.0) >= figures.get("people", 1.0)
    if not flat and figures.get("joints") != 0:
        return figures
    names = ("mean_ray_distance_m", "standard_deviation_m", "filled_share")
    return {**dict.fromkeys(names, 0.0), **figures}


def _of_people(figures: Figures) -> Figures:
    """Zero `bridged_share` with a stride: then boxes are interpolated on purpose."""
    return {**figures, "bridged_share": 0.0} if figures.get("stride", 1) > 1 else figures


def _of_adjustment(figures: Figures) -> Figures:
    before, after = figures.get("held_out_error_before_px"), figures.get("held_out_error_after_px")
    if after is None or not before:
        # Nobody is held out: a question only if a camera was changed all the same.
        names = ("held_out_error_after_px", "held_out_growth")
        is_kept = figures.get("cameras_changed") == 0.0
        return {**dict.fromkeys(names, 0.0), **figures} if is_kept else figures
    # Above 1 by chance: the loss of the same people does not rise beyond its standard error.
    certain = figures.get("held_out_significance", -CHANCE) <= -CHANCE
    growth = after / before
    return {**figures, "held_out_growth": growth if certain else min(growth, 1.0)}


def _of_bodies(figures: Figures) -> Figures:
    share = figures["filled"] / figures["bodies"] if figures["bodies"] else 0.0
    # With two cameras none can be held out, and nothing is compared.
    by_group = [value for name, value in figures.items() if name.startswith(f"{EXCESS}.")]
    return {**figures, "filled_share": share, EXCESS: max(by_group, default=0.0)}


GATES: Final[Mapping[str, Gate]] = {
    gate.stage: gate
    for gate in (
        Gate(
            "static_calibration",
            "Do the projected markings match those in the image, in all parts of it?",
            CameraLimits(),
            "the clicks of this camera",
        ),
        Gate(
            "detection",
            "Are exactly the people on the pitch detected?",
            PeopleLimits(),
            "the people in this video, or the video itself",
            _of_people,
        ),
        Gate(
            "camera_consistency",
            "Are these cameras wrong, for this reason? If you approve, the run leaves them out.",
            ConsistencyLimits(),
            "the clicks or the clock of the cameras that are named",
        ),
        Gate(
            "tracking",
            "Is every person one track over the whole clip?",
            IdentityLimits(),
            "the tracks: split, join; or clicks and clocks of cameras that disagree",
            _in_3d,
        ),
        Gate(
            "triangulation",
            "Are the joints where the images show them, and are the cameras healthy?",
            JointLimits(),
            "the keypoints in the images, or the cameras",
            _in_3d,
        ),
        Gate(
            "bundle_adjustment",
            "Did the adjustment improve the cameras, and are its outliers correct?",
            AdjustmentLimits(),
            "the outliers that are listed",
            _of_adjustment,
        ),
        Gate(
            "body_fitting",
            "Is the clip good enough to be released?",
            ClipLimits(),
            "the tracks and the keypoints that are off",
            _of_bodies,
        ),
        Gate(
            "broadcast_calibration",
            "Does the drawn pitch match the pitch in the image in every frame?",
            BroadcastLimits(),
            "the key frames of this camera",
        ),
    )
}
"""Stage to its review gate, in the order of the method, for `--gates auto` and `always`."""

ALWAYS: Final = "every result is asked about"


@dataclass(frozen=True)
class Gatekeeper:
    """Decides which results pass and which need review."""

    store: Store
    match: Match
    policy: GatePolicy

    def list_held_units(self, stage: str, results: Mapping[str, str]) -> tuple[WaitingUnit, ...]:
        """Return the units of `stage` in `results` that later stages must not use yet.

        A verdict applies to a result's bytes, and overrides metrics and policy: a rejected result
        waits for a correction, however good its metrics are.
        """
        gate = GATES.get(stage)
        if gate is None or (self.policy == "never" and not self._has_refusals()):
            return ()
        waiting = []
        for name, key in results.items():
            if name.partition("/")[0] != stage:
                continue
            manifest = self._manifest(name, key)
            decision = last_decision(self.match.journal.questions, name, manifest.content)
            if decision is None:
                reasons = self._reasons(gate, manifest)
                if reasons and self._is_known(gate, name, manifest, reasons):
                    continue
                if reasons:
                    request = request_id(name, key)
                    waiting.append(WaitingUnit(unit=name, request=request, reasons=reasons))
            elif decision.verdict == "reject":
                said = f"{decision.who} rejected it" + (f": {decision.why}" * bool(decision.why))
                waiting.append(
                    WaitingUnit(unit=name, request=decision.request, reasons=(said,), rejected=True)
                )
        return tuple(waiting)

    def ask(self, run_id: str, waiting: Sequence[WaitingUnit], results: Mapping[str, str]) -> None:
        """Add review requests to the journal, one per result."""
        requests = [
            self._request(unit, results[unit.unit], run_id) for unit in waiting if not unit.rejected
        ]

        def new_requests(journal: Journal) -> list[ReviewRequest]:
            known = requests_by_id(journal.questions)
            return [request for request in requests if request.id not in known]

        if requests:
            say(self.store, self.match.match_id, new_requests)

    def _reasons(self, gate: Gate, manifest: ResultManifest) -> tuple[str, ...]:
        """Return why a result without a verdict needs review."""
        if self.policy == "never":
            return ()
        asked = (ALWAYS,) if self.policy == "always" else ()
        left_out = (
            f"camera {camera} would be left out: {reason}"
            for camera, reason in manifest.left_out.items()
        )
        return (*asked, *left_out, *gate.objections(manifest.figures))

    def _is_known(
        self, gate: Gate, name: str, manifest: ResultManifest, reasons: Sequence[str]
    ) -> bool:
        """Return whether people approved the same metrics of an earlier result of this unit.

        A metric that got no worse is the same question. Counts, whose limit is zero, can be of
        other things, and are asked about again.
        """
        journal = self.match.journal
        asked = requests_by_id(journal.questions)
        decided = [
            each
            for each in journal.questions
            if isinstance(each, ReviewDecision)
            and each.request in asked
            and name in asked[each.request].keys
        ]
        is_approved = bool(decided) and decided[-1].verdict == "approve"
        if not is_approved or self.policy == "always" or manifest.left_out:
            return False
        before = gate.judged(asked[decided[-1].request].figures)
        now = gate.judged(manifest.figures)
        return all(
            limit > 0.0
            and metric in before
            and metric in now
            and not exceeds(now[metric], before[metric])
            for metric, limit in gate.limits
            if any(reason.startswith(f"{metric} ") for reason in reasons)
        )

    def _has_refusals(self) -> bool:
        return any(
            isinstance(record, ReviewDecision) and record.verdict == "reject"
            for record in self.match.journal.questions
        )

    def _request(self, unit: WaitingUnit, key: str, run_id: str) -> ReviewRequest:
        manifest = self._manifest(unit.unit, key)
        return ReviewRequest(
            id=unit.request,
            match_id=self.match.match_id,
            run_id=run_id,
            gate=unit.unit.partition("/")[0],
            keys={unit.unit: key},
            contents={unit.unit: manifest.content},
            reasons=unit.reasons,
            figures=manifest.figures,
            created_at=datetime.now(UTC),
        )

    def _manifest(self, name: str, key: str) -> ResultManifest:
        stage, _, unit = name.partition("/")
        return self.store.manifest(self.match.match_id, stage, unit, key)


def request_id(unit: str, key: str) -> str:
    """Return the review request id of a result: `static_calibration.cam03.1f2e3d4c5b6a`."""
    stage, _, name = unit.partition("/")
    return f"{stage[:24]}.{name[:24]}.{key[:12]}"


def waiting_for_verdicts(waiting: Iterable[WaitingUnit]) -> list[WaitingUnit]:
    """Return the units without a verdict; the others wait for corrections."""
    return [unit for unit in waiting if not unit.rejected]
