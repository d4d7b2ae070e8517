"""Gates: where a person is asked before a run goes on, and which figures ask for it.

A gate stands behind a stage and looks at each of its results on its own; `GATES`, beside
`METHOD`, names them all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pydantic import Field

from data_contracts.records import Record

Figures = Mapping[str, float]


def _as_they_are(figures: Figures) -> Figures:
    return figures


@dataclass(frozen=True)
class Gate:
    """Where a person is asked.

    Attributes:
        stage: the stage behind which it stands, which also names it.
        question: what a person is to decide.
        limits: a record of the largest figures with which `auto` lets a result pass.
        judged: the figures that are held against the limits, from a result's.
        warned: figures of which a run warns that asks no person: beyond their limit, the result is
            probably wrong. Beyond others it is less accurate than it could be.
    """

    stage: str
    question: str
    limits: Record
    judged: Callable[[Figures], Figures] = _as_they_are
    warned: tuple[str, ...] = ()

    def warnings(self, figures: Figures) -> tuple[str, ...]:
        """Return a line for each figure that says that the result is probably wrong."""
        judged = self.judged(figures) if figures else {}
        return tuple(
            _beyond(name, judged[name], limit)
            for name, limit in self.limits
            if name in self.warned and judged.get(name, 0.0) > limit
        )

    def objections(self, figures: Figures) -> tuple[str, ...]:
        """A line for each figure beyond its limit; none where `auto` lets the result pass.

        A result without any figure, such as a camera that was given, was somebody's to judge
        before. A figure that could not be computed is beyond every limit.
        """
        if not figures:
            return ()
        judged = self.judged(figures)
        lines = []
        for name, limit in self.limits:
            if name not in judged:
                lines.append(f"{name} could not be computed")
            elif judged[name] > limit:
                lines.append(_beyond(name, judged[name], limit))
        return tuple(lines)

    def excess(self, figures: Figures) -> float:
        """How far the worst figure is beyond its limit [1]: 0 within, 1 at twice the limit.

        Of a limit of zero it is the figure itself.
        """
        judged = self.judged(figures)
        beyond = [
            judged[name] / limit - 1.0 if limit else judged[name]
            for name, limit in self.limits
            if name in judged
        ]
        return max([0.0, *beyond])


def _beyond(name: str, figure: float, limit: float) -> str:
    return f"{name} is {figure:.4g}, at most {limit:.4g} passes"


class CameraLimits(Record):
    """What a calibrated static camera may show."""

    expected_ground_error_median_m: float = Field(default=0.03, ge=0)
    """Expected error on the pitch, median over what the camera sees [m]. Joints of five views have
    a standard deviation of 0.03 themselves; clicks with a still's lines reach 0.01 to 0.02, clicks
    alone 0.05 to 0.2 on simulated cameras."""
    expected_ground_error_p95_m: float = Field(default=0.10, ge=0)
    """The same at its 95th percentile [m]: the far side, where a pixel is 5 to 20 cm."""
    clicks_wrong: float = Field(default=0, ge=0)
    """Clicks that the others contradict [1]. One click at the wrong marking looks like this, and
    whoever made it knows in a glance which of the two is right."""
    weak: float = Field(default=0, ge=0)
    """1 where the clicks leave a direction of the camera open [1]."""


class PeopleLimits(Record):
    """What the people found in a camera's clip may show (D6)."""

    unreadable_share: float = Field(default=0.02, ge=0)
    """Frames whose picture is missing or damaged [1]: half a second of a minute is a recorder's
    hiccup; more is a video to be looked at."""
    empty_share: float = Field(default=0.5, ge=0)
    """Pictures in which nobody was found [1]. A camera looks away from play at times; one that sees
    nobody for half a clip is turned, dark or beyond what the detector knows."""
    bridged_share: float = Field(default=0.25, ge=0)
    """Boxes that were filled in between two looks [1]; a quarter says that the detector misses."""
    flicker_share: float = Field(default=0.10, ge=0)
    """Boxes of tracks seen too seldom to be kept, per box that was [1]: turf, boards and crowd that
    now and then look like somebody."""


class ConsistencyLimits(Record):
    """What static cameras may show of each other; a camera that is left out is asked about too."""

    contradictions: float = Field(default=0, ge=0)
    """Cameras that contradict another where nothing tells which is wrong [1]."""


class IdentityLimits(Record):
    """What the tracks of a clip may show."""

    undecided: float = Field(default=0, ge=0)
    """Joins of two tracks for and against which the evidence is too even [1]: a person sees at once
    what a wrong guess would spoil for good."""
    unmatched_share: float = Field(default=0.15, ge=0)
    """Detections that belong to nobody [1]: staff and crowd are some, a camera out of step or place
    makes many."""
    mean_ray_distance_m: float = Field(default=0.15, ge=0)
    """How far the rays of matched detections pass each other [m]: beyond a shoulder's width of
    0.4 m people are mixed up, and a third of it says that cameras disagree."""
    corrections_refused: float = Field(default=0, ge=0)
    """Corrections of who is who that do not fit these tracks [1]: what a person said is not in
    them."""


class JointLimits(Record):
    """What the triangulated joints of a clip may show."""

    standard_deviation_m: float = Field(default=0.10, ge=0)
    """Of a joint along an axis, median over joints [m]; 0.03 with five views."""
    filled_share: float = Field(default=0.05, ge=0)
    """Joints that are there by motion alone [1]."""


class AdjustmentLimits(Record):
    """What adjusted cameras may show.

    How many changes left-out people refused is no limit: cameras that were good already need none.
    """

    held_out_error_after_px: float = Field(default=5.0, ge=0)
    """Median distance of left-out people's keypoints to where the adjusted cameras put them [px];
    1.5 to 2.4 on simulated matches."""
    held_out_growth: float = Field(default=1.0, ge=0)
    """The same over what it was before adjustment [1]: above 1 it did harm."""


class ClipLimits(Record):
    """What the bodies of a clip may show before it is released."""

    offset_rms_m: float = Field(default=0.03, ge=0)
    """What the detector takes for a joint against the body's, along an axis [m]; 0.005 to 0.015
    where the body fits."""
    filled_share: float = Field(default=0.05, ge=0)
    """Bodies in frames without any joint of the person [1]."""


class BroadcastLimits(Record):
    """What the calibrated broadcast camera of a clip may show."""

    expected_error_median_px: float = Field(default=3.0, ge=0)
    """Expected error of the pitch in a frame's picture, median over frames [px]. A painted line
    of 0.12 m is 4 px wide at 60 m through a focal length of 2000 px: beyond 3 px the drawn pitch
    leaves the picture's for the eye."""
    weak: float = Field(default=0, ge=0)
    """1 where something of the clip has to be looked at, as its report says [1]."""


def _of_people(figures: Figures) -> Figures:
    """With a stride, boxes between two looks are filled in on purpose and tell nothing."""
    return {**figures, "bridged_share": 0.0} if figures.get("stride", 1) > 1 else figures


def _of_adjustment(figures: Figures) -> Figures:
    after, before = (figures.get(f"held_out_error_{side}_px") for side in ("after", "before"))
    if after is None or not before:
        return figures
    return {**figures, "held_out_growth": after / before}


def _of_bodies(figures: Figures) -> Figures:
    share = figures["filled"] / figures["bodies"] if figures["bodies"] else 0.0
    return {**figures, "filled_share": share}


CAMERAS = Gate(
    "static_calibration", "Do the markings lie on the picture's, all over it?", CameraLimits()
)
PEOPLE = Gate(
    "detection", "Is everybody on the pitch found, and nobody else?", PeopleLimits(), _of_people
)
CONSISTENCY = Gate(
    "camera_consistency", "Are these cameras wrong, for this reason?", ConsistencyLimits()
)
IDENTITIES = Gate(
    "tracking",
    "Is every person one track, from end to end?",
    IdentityLimits(),
    warned=("unmatched_share", "mean_ray_distance_m"),
)
JOINTS = Gate(
    "triangulation",
    "Are the joints where the pictures show them?",
    JointLimits(),
    warned=("standard_deviation_m",),
)
ADJUSTMENT = Gate(
    "bundle_adjustment",
    "Did adjustment mend the cameras, and are its outliers outliers?",
    AdjustmentLimits(),
    _of_adjustment,
)
ACCEPTANCE = Gate(
    "body_fitting", "Is the clip good enough to be released?", ClipLimits(), _of_bodies
)
BROADCAST = Gate(
    "broadcast_calibration",
    "Does the drawn pitch stay on the picture's, from the first frame to the last?",
    BroadcastLimits(),
)
