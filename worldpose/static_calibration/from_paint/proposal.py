"""Cameras and markings proposed from an image alone, without a click.

Paint is the evidence. Three straight segments, two along one axis of the pitch and one along the
other, with names from the template and a level camera, determine a camera; so do one segment and a
circle. Every plausible assignment gives a candidate; the paint that it explains, and the markings
that it predicts and the image lacks, decide. The best ones are refined on the nearest paint.

The pitch looks the same after half a turn. The side on which the camera stands decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from data_contracts.arrays import Image
from data_contracts.cameras import COEFFICIENTS, LensCalibration
from data_contracts.match import Side
from data_contracts.static_calibration import ClickedMarkings, DrawnMarking
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_fit import refit_lens
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.from_paint.candidates import (
    INDEPENDENT,
    Candidates,
    SeenMarkings,
    explained_share,
    project_markings,
    stand_on,
)
from worldpose.static_calibration.from_paint.paint import PaintMap, find_paint, restore_colors
from worldpose.static_calibration.from_paint.ranking import (
    FINE,
    MIN_MARGIN,
    ON_PAINT,
    RankedCameras,
    rank_under_lenses,
    runner_up,
    share_on_paint,
)
from worldpose.static_calibration.from_paint.thin_paint import trace_marking
from worldpose.static_calibration.ground_error import points_in_view
from worldpose.static_calibration.line_samples import LineSamples, sample_markings
from worldpose.static_calibration.parameters import drop_k3
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.settings import CameraPrior, StaticCalibrationSettings
from worldpose.static_calibration.sides import turn_camera, turn_name

PROPOSED: Final = "markings proposed from the image"
"""How the first decision of a camera without clicks begins."""
MIN_FOUND: Final = 0.6
"""Minimum share of its markings on paint [1]."""
MIN_EXPLAINED: Final = 0.25
"""Minimum share of the straight paint on its markings [1]: a small part of the pitch may fit any
two lines."""
_TO_CLICK: Final = "Click four or more named points of this camera, such as corners of areas."


@dataclass(frozen=True)
class MarkingSupport:
    """One marking, its visible length in the straight copy [px], and its share on paint [1]."""

    name: str
    visible_px: float
    found: float


@dataclass(frozen=True, eq=False)
class Proposal:
    """A camera found without a click, and the evidence for it.

    Attributes:
        camera: pose, focal length and k1; no covariance: a calibration from `drawn` has one.
        drawn: pixels on the paint of every marking that was found.
        markings: what was expected and found, the longest first.
        score: log probability ratio to an image without a pitch [1].
        margin: score above the best other camera [1].
        found: share of the expected markings on paint, by length [1].
        explained: share of the segments' length on a marking [1].
    """

    camera: Camera
    drawn: ClickedMarkings
    markings: tuple[MarkingSupport, ...]
    score: float
    margin: float
    found: float
    explained: float

    @property
    def is_clear(self) -> bool:
        """Whether the proposal may be used without a click."""
        enough = self.found >= MIN_FOUND and self.explained >= MIN_EXPLAINED
        return self.margin >= MIN_MARGIN and enough

    def require_clear(self, where: str, pitch: PitchTemplate) -> None:
        """Raise InputError, with what to click, for a proposal that is not clear without a click.

        Then the image shows too little, or other cameras explain it nearly as well.
        """
        if self.is_clear:
            return
        lacking = [each.name for each in self.markings if each.found < 0.5]
        found = []
        if self.margin < MIN_MARGIN:
            found.append(f"another camera explains it nearly as well (margin {self.margin:.0f})")
        if self.found < MIN_FOUND:
            found.append(f"{self.found:.0%} of the markings that it would see are on paint")
        if self.explained < MIN_EXPLAINED:
            found.append(f"{self.explained:.0%} of the paint lies on its markings")
        if lacking:
            found.append(f"not found: {', '.join(lacking[:4])}")
        clear = [each.name for each in self.markings if each.found >= 0.5]
        points = points_in_view(self.camera, pitch, clear)
        raise InputError(
            where,
            expected=f"one camera that explains the paint (margin {MIN_MARGIN:g}, "
            f"{MIN_FOUND:.0%} of the markings on paint, "
            f"{MIN_EXPLAINED:.0%} of the paint on markings)",
            found="; ".join(found),
            todo=_TO_CLICK
            + (f" If the proposed camera is right, it sees {', '.join(points)}." if points else ""),
        )

    def turn(self) -> Proposal:
        """Return the proposal of the same camera half a turn about the centre spot away."""
        drawn = tuple(
            each.model_copy(update={"name": turn_name(each.name)}) for each in self.drawn.drawn
        )
        return replace(
            self,
            camera=turn_camera(self.camera),
            drawn=ClickedMarkings(drawn=drawn),
            markings=tuple(replace(each, name=turn_name(each.name)) for each in self.markings),
        )

    def attributes(self) -> dict[str, Any]:
        """Return all but the camera, for a store."""
        return {
            "drawn": {each.name: [list(xy) for xy in each.xy] for each in self.drawn.drawn},
            "markings": [[each.name, each.visible_px, each.found] for each in self.markings],
            "score": self.score,
            "margin": self.margin,
            "found": self.found,
            "explained": self.explained,
        }

    @classmethod
    def from_attributes(cls, camera: Camera, stored: Mapping[str, Any]) -> Proposal:
        """Return a proposal from its camera and its stored attributes."""
        drawn = tuple(DrawnMarking(name=name, xy=xy) for name, xy in stored["drawn"].items())
        return cls(
            camera=camera,
            drawn=ClickedMarkings(drawn=drawn),
            markings=tuple(
                MarkingSupport(name, visible, found) for name, visible, found in stored["markings"]
            ),
            score=stored["score"],
            margin=stored["margin"],
            found=stored["found"],
            explained=stored["explained"],
        )


def propose_camera(
    picture: Image,
    pitch: PitchTemplate,
    *,
    side: Side,
    prior: CameraPrior | None = None,
    lens: LensCalibration | None = None,
    where: str = "image",
) -> Proposal:
    """Return the camera that explains the paint of an image best.

    If the image as it is has no clear one, the search is repeated with restored colors. There the
    cameras of the first search remain rivals: colors do not decide between cameras that explain the
    same paint.

    `picture` (height, width, 3) is RGB; the camera stands at `side`. Messages begin with `where`.

    Raises:
        InputError: there is no grass, or too little paint for a camera.

    Note:
        The homography of line correspondences follows Hartley and Zisserman 2004, chapter 8; the
        search over names is exhaustive.
    """
    height, width = picture.shape[:2]
    given = None if lens is None else Camera.from_lens(lens, (width, height))

    likely = (prior or CameraPrior()).beside(pitch.spec)

    def search(
        shown: Image, rivals: RankedCameras | None = None
    ) -> tuple[RankedCameras | None, Proposal | None]:
        paints = find_paint(shown, given, where)
        ranked = rank_under_lenses(paints, pitch, likely, given, rivals)
        return ranked, None if ranked is None else _propose_first(ranked, pitch, side)

    ranked, found, refused = None, None, None
    try:
        ranked, found = search(picture)
    except InputError as error:
        if picture.ndim != 3:
            raise
        refused = error
    if found is None or not found.is_clear:
        with suppress(InputError):
            _, again = search(restore_colors(picture), ranked)
            # What the first search found unclear has to be clear beyond doubt: on a real still both
            # found one camera, with margins of 23 and 25; where colors helped, 50 to 126.
            if again is not None and (
                found is None or (again.is_clear and again.margin >= 2.0 * MIN_MARGIN)
            ):
                found = again
    if found is None:
        raise refused or InputError(
            where,
            expected="three straight markings, one across the others, or one and a circle",
            found="paint that fits no camera",
            todo=_TO_CLICK,
        )
    return found


def propose_from_paint(
    paints: Iterable[PaintMap], pitch: PitchTemplate, *, side: Side
) -> Proposal | None:
    """Return the camera at a side of the pitch that explains the paint of an image best, or None.

    The paint is that under every lens that the image may have, the likely one first.
    """
    found = rank_under_lenses(paints, pitch, CameraPrior().beside(pitch.spec), None)
    return None if found is None else _propose_first(found, pitch, side)


def _propose_first(found: RankedCameras, pitch: PitchTemplate, side: Side) -> Proposal:
    """Return the proposal of the first of an image's cameras, on a side of the pitch."""
    paint, ranked, scores = found
    samples, best = sample_markings(pitch, FINE[0]), stand_on(ranked[:1], side)
    seen = project_markings(paint, samples, best)
    markings, drawn = _measure_support(paint, samples, seen)
    return Proposal(
        _to_camera(best, paint),
        drawn,
        markings,
        float(scores[0]),
        float(scores[0]) - runner_up(scores),
        share_on_paint(seen),
        explained_share(paint, seen),
    )


def calibrate_proposal(
    pitch: PitchTemplate,
    proposal: Proposal,
    picture: Image,
    *,
    settings: StaticCalibrationSettings | None = None,
    where: str = "image",
    lens: LensCalibration | None = None,
) -> StaticCalibration:
    """Return the camera of a clear proposal in an RGB image, its covariance and its report.

    The proposed markings are calibrated as if they had been drawn.

    Raises:
        InputError: the proposal is not clear, or the calibration disagrees with it.
    """
    stated = settings or StaticCalibrationSettings()
    proposal.require_clear(where, pitch)
    height, width = picture.shape[:2]

    def calibrate(drawn: ClickedMarkings) -> StaticCalibration:
        return calibrate_camera(
            pitch,
            drawn,
            (width, height),
            picture=picture,
            settings=stated,
            where=where,
            lens=lens,
            start=proposal.camera if lens is not None else drop_k3(proposal.camera),
        )

    calibration = calibrate(proposal.drawn)
    thin = _trace_thin_markings(calibration, pitch, picture, stated)
    if thin:
        names = {each.name for each in thin}
        kept = (each for each in proposal.drawn.drawn if each.name not in names)
        calibration = calibrate(ClickedMarkings(drawn=(*kept, *thin)))
    lines = calibration.report.lines  # each camera has its own ground
    if lines is not None and not lines.refined:
        # The proposal is made of painted lines: a right one leads the search to them.
        raise InputError(
            where,
            expected="painted lines where the proposed camera projects the markings",
            found=lines.reason,
            todo=_TO_CLICK,
        )
    surfaced = pitch if lines is None else pitch.with_surface(lines.estimate.surface)
    pixels, calibrated_pixels = (
        camera.project(ground.sample_lines(FINE[0]).points_world)
        for camera, ground in ((proposal.camera, pitch), (calibration.estimate.camera, surfaced))
    )
    inside = ((pixels >= 0.0) & (pixels <= [width - 1.0, height - 1.0])).all(axis=1)
    moved = float(np.median(np.linalg.norm(pixels - calibrated_pixels, axis=1)[inside]))
    if not moved < 0.01 * width:
        raise InputError(
            where,
            expected="the calibration close to the proposal of the image",
            found=f"markings {moved:.0f} px apart (median)",
            todo=_TO_CLICK,
        )
    decision = (
        f"{PROPOSED}: {proposal.found:.0%} of their length on paint, "
        f"{proposal.margin:.0f} above other cameras"
    )
    decisions = (decision, *calibration.report.decisions)
    return replace(calibration, report=replace(calibration.report, decisions=decisions))


def _trace_thin_markings(
    calibration: StaticCalibration,
    pitch: PitchTemplate,
    picture: Image,
    settings: StaticCalibrationSettings,
) -> tuple[DrawnMarking, ...]:
    """Return pixels on the markings whose paint is too thin for the search of painted lines.

    They hold the camera beyond the last line found: on two real cameras the far touch line was 3.6
    px off without them, 1.1 m on the ground.
    """
    lines = calibration.report.lines
    if lines is None or not lines.refined:
        return ()
    camera, there = calibration.estimate.camera, pitch.with_surface(lines.estimate.surface)
    searched = {each.name for each in lines.markings}
    found = []
    for name in (each for each in pitch.lines if each not in searched):
        pixels = camera.project(there.marking_points(name, settings.sample_spacing_m))
        traced = trace_marking(picture, pixels)
        if len(traced):
            found.append(DrawnMarking(name=name, xy=tuple((x, y) for x, y in traced.tolist())))
    return tuple(found)


def _measure_support(
    paint: PaintMap, samples: LineSamples, seen: SeenMarkings
) -> tuple[tuple[MarkingSupport, ...], ClickedMarkings]:
    """Return each visible marking's support, and the pixels of those that were found."""
    support, drawn = [], []
    for index, name in enumerate(samples.names):
        mine = (samples.marking == index) & (seen.lengths[0] > 0.0)
        length = float(seen.lengths[0, mine].sum())
        if length < ON_PAINT:
            continue
        on = mine & (seen.distances[0] < ON_PAINT)
        found = float(seen.lengths[0, on].sum()) / length
        support.append(MarkingSupport(name, length, found))
        # Thin far lines are found in pieces.
        if found * length < INDEPENDENT * paint.size[0] or found < 0.4:
            continue
        nearest, place = np.unique(seen.nearest[0, on], return_index=True)
        chosen = np.linspace(0, len(nearest) - 1, min(len(nearest), 40)).astype(np.int64)
        chosen = chosen[np.argsort(place[chosen])]  # in order along the marking
        pixels = paint.origins[nearest[chosen]]
        drawn.append(DrawnMarking(name=name, xy=tuple((x, y) for x, y in pixels.tolist())))
    support.sort(key=lambda each: -each.visible_px)
    return tuple(support), ClickedMarkings(drawn=tuple(drawn))


def _to_camera(candidates: Candidates, paint: PaintMap) -> Camera:
    """Return the first candidate, a camera of the straight copy, as a camera of the image."""
    rotation, center = candidates.rotations[0], candidates.centers[0]
    stretch = float(candidates.focals[0]) / paint.focal
    # The lens of a camera `stretch` times as long has the same curvature in pixels.
    distortion = paint.lens.distortion * stretch ** np.array([2, 4, 1, 1, 6, 2, 4, 6])
    if paint.lens.lens_model == LensModel.FISHEYE:
        free = COEFFICIENTS["fisheye"]
        distortion = refit_lens(paint.lens, LensModel.FISHEYE, free, stretch).camera.distortion
    distortion = distortion + candidates.radial[0] * np.eye(8)[0]
    return replace(
        paint.lens,
        focal=paint.lens.focal * stretch,
        distortion=distortion,
        cam_from_world=Rigid(rotation, -rotation @ center),
    )
