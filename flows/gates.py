"""Review gates: where a run waits for review, and the metric limits that require it.

A gate follows a stage and checks each of its results separately; `GATES` lists all gates. The
`Gatekeeper` of a run decides from verdicts, metrics and policy which results need review.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

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
        limits: the largest metrics that `auto` lets pass.
        judged: maps a result's metrics to those that are compared with the limits.
    """

    stage: str
    question: str
    limits: Mapping[str, float]
    to_correct: str
    judged: Callable[[Figures], Figures] = lambda figures: figures

    def objections(self, figures: Figures) -> dict[str, str]:
        """Return metrics beyond their limits, with a line each; none if `auto` lets a result pass.

        A result without any metric, such as a given camera, passes: it was judged before the run. A
        metric that could not be computed is beyond every limit.
        """
        if not figures:
            return {}
        judged = self.judged(figures)
        lines = {}
        for name, limit in self.limits.items():
            if name not in judged:
                lines[name] = f"{name} could not be computed"
            elif exceeds(judged[name], limit):
                parts = [
                    key.removeprefix(f"{name}.")
                    for key, value in judged.items()
                    if key.startswith(f"{name}.") and exceeds(value, limit)
                ]
                named = f" ({', '.join(parts)})" if parts else ""
                lines[name] = f"{name} is {judged[name]:.4g}{named}, at most {limit:.4g} passes"
        return lines

    def excess(self, figures: Figures) -> float:
        """Return the relative excess of the worst metric [1]: 0 within, 1 at twice the limit.

        For a limit of zero it is the metric itself.
        """
        judged = self.judged(figures)
        beyond = [
            judged[name] / limit - 1.0 if limit else judged[name]
            for name, limit in self.limits.items()
            if name in judged
        ]
        return max([0.0, *beyond])


def exceeds(value: float, limit: float) -> bool:
    """Return whether a metric exceeds a limit with the digits that the reason shows; NaN does."""
    return not float(f"{value:.4g}") <= float(f"{limit:.4g}")


_CALIBRATION: Final = StaticCalibrationSettings()
_USABLE: Final = UsableLimits()
EXCESS: Final = "held_out_certain_excess_m"


def _in_3d(figures: Figures) -> Figures:
    """Pass absent metrics of people in 3D if no person is in 3D: the run says so, and why."""
    flat = figures.get("plane_people", 0.0) >= figures.get("people", 1.0)
    if not flat and figures.get("joints") != 0:
        return figures
    names = ("mean_ray_distance_m", "standard_deviation_m", "filled_share")
    return {**dict.fromkeys(names, 0.0), **figures}


def _of_adjustment(figures: Figures) -> Figures:
    before, after = figures.get("held_out_error_before_px"), figures.get("held_out_error_after_px")
    if after is None or not before:
        # Nobody is held out: a question only if a camera was changed all the same.
        names = ("held_out_error_after_m", "held_out_growth")
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
    own = {"filled_share": share, EXCESS: max(by_group, default=0.0)}
    return {**({} if figures["bodies"] else {"offset_rms_m": 0.0}), **figures, **own}


GATES: Final[Mapping[str, Gate]] = {
    gate.stage: gate
    for gate in (
        Gate(
            "static_calibration",
            "Do the projected markings match those in the image, in all parts of it?",
            {
                # Median over the visible pitch: the limit of which the calibration page warns.
                "expected_ground_error_median_m": _CALIBRATION.weak_median_m,
                # The far side, where a pixel is 5 to 20 cm.
                "expected_ground_error_p95_m": _CALIBRATION.weak_p95_m,
                # The annotator sees at once which click is wrong.
                "clicks_wrong": 0.0,
                # 1 if the clicks leave a direction of the camera undetermined.
                "weak": 0.0,
            },
            "the clicks of this camera",
        ),
        Gate(
            "detection",
            "Are exactly the people on the pitch detected?",
            {
                # Frames without an image are no question, but a reservation: no page adds them.
                # A camera without people for half a clip is turned, dark or outside of training.
                "empty_share": 0.5,
                # Boxes interpolated between two processed frames: the detector misses too many.
                "bridged_share": 0.25,
                # Boxes of discarded short tracks per kept box: turf, boards and crowd.
                "flicker_share": 0.10,
            },
            "the people in this video, or the video itself",
            # With a stride, boxes are interpolated on purpose.
            lambda own: {**own, "bridged_share": 0.0} if own.get("stride", 1) > 1 else own,
        ),
        Gate(
            "camera_consistency",
            "Are these cameras wrong, for this reason? If you approve, the run leaves them out.",
            {
                # Cameras that contradict another with no evidence which is wrong.
                "contradictions": 0.0
            },
            "the clicks or the clock of the cameras that are named",
        ),
        Gate(
            "tracking",
            "Is every person one track over the whole clip?",
            {
                # Ambiguous joins: a wrong guess corrupts all that follows.
                "undecided": 0.0,
                # People beside the pitch are a quarter of the detections at a small ground: the
                # verdict names them. At half, a clock or a camera is wrong, or the net is.
                "unmatched_share": _USABLE.max_unusable_share,
                "mean_ray_distance_m": _USABLE.max_ray_distance_m,
                # Identity corrections that do not fit these tracks, which lack them.
                "corrections_refused": 0.0,
            },
            "the tracks: split, join; or clicks and clocks of cameras that disagree",
            _in_3d,
        ),
        Gate(
            "triangulation",
            "Are the joints where the images show them, and are the cameras healthy?",
            {
                "standard_deviation_m": _USABLE.max_standard_deviation_m,
                "filled_share": _USABLE.max_filled_share,
                # Share of the clip in which the worst camera departs from people or shows little.
                "unhealthy_share": _USABLE.max_absent_share,
            },
            "the keypoints in the images, or the cameras",
            _in_3d,
        ),
        Gate(
            "bundle_adjustment",
            "Did the adjustment improve the cameras, and are its outliers correct?",
            {
                # Of held-out people in the adjusted cameras, at their distance: pixels would depend
                # on how large people are. Usual are 0.03 to 0.05, as far as keypoints err.
                "held_out_error_after_m": 0.1,
                # Relative to before the adjustment: above 1 it did harm.
                "held_out_growth": 1.0,
            },
            "the outliers that are listed",
            _of_adjustment,
        ),
        Gate(
            "body_fitting",
            "Is the clip good enough to be released?",
            {
                "offset_rms_m": _USABLE.max_body_offset_m,
                # Share of bodies in frames without any joint of the person.
                "filled_share": 0.05,
                # Of the worst joint group.
                EXCESS: _USABLE.max_body_excess_m,
            },
            "the tracks and the keypoints that are off",
            _of_bodies,
        ),
        Gate(
            "broadcast_calibration",
            "Does the drawn pitch match the pitch in the image in every frame?",
            {
                "expected_error_median_px": _USABLE.max_broadcast_error_px,
                # 1 if the clip's report asks for a check.
                "weak": 0.0,
            },
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
        gate, questions = GATES.get(stage), self.match.journal.questions
        verdicts = (it.verdict for it in questions if isinstance(it, ReviewDecision))
        if gate is None or (self.policy == "never" and "reject" not in verdicts):
            return ()
        waiting = []
        for name, key in results.items():
            of, _, unit = name.partition("/")
            if of != stage:
                continue
            manifest = self._manifest(name, key)
            decision = last_decision(questions, name, manifest.content)
            if decision is None:
                reasons = self._reasons(gate, manifest)
                if reasons and self._is_known(gate, name, manifest):
                    continue
                if reasons:
                    request = f"{stage[:24]}.{unit[:24]}.{key[:12]}"
                    waiting.append(WaitingUnit(unit=name, request=request, reasons=reasons))
            elif decision.verdict == "reject":
                said = f"{decision.who} rejected it" + (f": {decision.why}" if decision.why else "")
                waiting.append(
                    WaitingUnit(unit=name, request=decision.request, reasons=(said,), rejected=True)
                )
        return tuple(waiting)

    def ask(self, run_id: str, waiting: Sequence[WaitingUnit], results: Mapping[str, str]) -> None:
        """Add review requests to the journal, one per result: `tracking.clip.1f2e3d4c5b6a`."""
        requests = []
        for unit in waiting:
            if unit.rejected:
                continue
            manifest = self._manifest(unit.unit, results[unit.unit])
            requests.append(
                ReviewRequest(
                    id=unit.request,
                    match_id=self.match.match_id,
                    run_id=run_id,
                    gate=unit.unit.partition("/")[0],
                    keys={unit.unit: manifest.key},
                    contents={unit.unit: manifest.content},
                    reasons=unit.reasons,
                    figures=manifest.figures,
                    created_at=datetime.now(UTC),
                )
            )

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
        return (*asked, *left_out, *gate.objections(manifest.figures).values())

    def _is_known(self, gate: Gate, name: str, manifest: ResultManifest) -> bool:
        """Return whether people approved the same metrics of an earlier result of this unit.

        A metric is the same question if it and its parts beyond the limit, such as cameras, got no
        worse. Counts, whose limit is zero, can be of other things, and are asked about again.
        """
        questions = self.match.journal.questions
        asked = requests_by_id(questions)
        decided = [
            each
            for each in questions
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
            gate.limits[metric] > 0.0
            and metric in now
            and all(
                part in before and not exceeds(value, before[part])
                for part, value in now.items()
                if part.partition(".")[0] == metric and exceeds(value, gate.limits[metric])
            )
            for metric in gate.objections(manifest.figures)
        )

    def _manifest(self, name: str, key: str) -> ResultManifest:
        stage, _, unit = name.partition("/")
        return self.store.manifest(self.match.match_id, stage, unit, key)


def waiting_for_verdicts(waiting: Iterable[WaitingUnit]) -> list[WaitingUnit]:
    """Return the units without a verdict; the others wait for corrections."""
    return [unit for unit in waiting if not unit.rejected]
