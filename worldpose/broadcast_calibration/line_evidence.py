"""Detection of painted lines in every frame, across the template's projection."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from data_contracts.arrays import Flags, Floats, Image, Integers
from worldpose.broadcast_calibration.evidence import (
    MARKING,
    PointEvidence,
    join_evidence,
    whiten_across,
)
from worldpose.broadcast_calibration.moving_camera import (
    CLIP_SIZE,
    FRAME_SIZE,
    MovingCamera,
    join_cameras,
)
from worldpose.broadcast_calibration.pitch_errors import PitchErrors
from worldpose.broadcast_calibration.residuals import field_residuals
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.geometry.optimize.arrow import ArrowSystem
from worldpose.pitch.template import PitchTemplate, surface_shape
from worldpose.static_calibration.line_detection import (
    CANDIDATES,
    CLEARANCE,
    CrossSections,
    find_bars,
    fit_bars,
)
from worldpose.static_calibration.line_samples import (
    EXACT_PAINT,
    LineSamples,
    WhiteStructures,
    clear,
    project_lines,
    sample_markings,
    thin_samples,
    white_structures,
)


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """Samples of the template's markings for the line search.

    Attributes:
        lines: samples of the painted markings, on the surface where they are searched.
        whites: all white structures, for the clearance test.
        errors: errors of the pitch.
        raised: (2,) crown and end fall of that surface less those of the template [m]. Evidence has
            the places of the template, which the fit displaces.
    """

    lines: LineSamples
    whites: WhiteStructures
    errors: PitchErrors
    raised: Floats

    @classmethod
    def of(cls, pitch: PitchTemplate, errors: PitchErrors, surface: Floats) -> FieldSamples:
        """Return a pitch's samples, with errors, on a surface of crown and end fall (2,) [m]."""
        there = pitch.with_surface(surface)
        raised = np.asarray(surface - pitch.surface)
        return cls(sample_markings(there, 0.25), white_structures(there), errors, raised)

    def lower(self, found: PointEvidence) -> PointEvidence:
        """Return evidence at the places of the template."""
        world = found.world.copy()
        world[:, 2] -= surface_shape(world[:, 0], world[:, 1], self.errors.size) @ self.raised
        return replace(found, world=world)


def find_lines(
    camera: MovingCamera,
    samples: FieldSamples,
    picture: Image,
    people: Floats | None,
    settings: BroadcastCalibrationSettings,
) -> tuple[PointEvidence, MovingCamera, Integers]:
    """Return the painted lines of a grey image (height, width), and its camera corrected by them.

    A first, wide search corrects rotation and zoom; a second, narrow search measures the lines.
    Boxes (detections, 4) [px] of people occlude lines; None = no people. The last value (n, 2) is
    the marking of each sample in view, and 1 where its paint was found.
    """
    reach = settings.line_search_px
    first, searched = _measure_lines(camera, samples, picture, people, settings, reach)
    if len(first) < 15:
        return PointEvidence.none(), camera, searched * np.array([1, 0])
    corrected = _correct_camera(camera, first, settings.field_weight)
    found, searched = _measure_lines(corrected, samples, picture, people, settings, 3.0)
    return samples.lower(found), corrected, searched


def _measure_lines(
    camera: MovingCamera,
    samples: FieldSamples,
    picture: Image,
    people: Floats | None,
    settings: BroadcastCalibrationSettings,
    reach: float,
) -> tuple[PointEvidence, Integers]:
    """Return bars of paint within reach of one frame's projected lines, as `find_lines`."""
    line_width = 0.12  # [m]; the maximum of Law 1, which most pitches have
    lines = _select_near(camera, samples.lines)
    seen = project_lines(camera.camera[0], lines, line_width, EXACT_PAINT)
    index = thin_samples(seen, lines, 4.0, settings.line_samples)
    if people is not None and len(index):
        index = index[~_find_hidden(seen.places[index], people, reach)]
    room = 0.5 * seen.widths[index] + CLEARANCE
    index = index[
        clear(
            camera.camera[0],
            samples.whites,
            0.5 * line_width,
            seen.places[index],
            room,
            lines.marking[index],
        )
    ]
    if not len(index):
        return PointEvidence.none(), np.empty((0, 2), dtype=np.int64)
    sections = seen[index].sections
    offsets, variances = _locate_bars(picture, sections, reach)
    found = np.isfinite(offsets)
    chosen = lines[index[found]]
    deviation = np.sqrt(variances[found] + settings.line_noise_px**2)
    seen_bars = PointEvidence.observe(
        MARKING,
        np.zeros(int(found.sum()), dtype=np.int64),
        chosen.points_world,
        (sections.places + offsets[:, None] * sections.normals)[found],
        whiten_across(sections.normals[found], deviation),
        source=chosen.marking,
        loss=settings.loss_scale,
    )
    searched = np.column_stack([lines.marking[index], found])
    return samples.errors.apply(seen_bars, chosen.ends, chosen.shares), searched


def _locate_bars(picture: Image, sections: CrossSections, reach: float) -> tuple[Floats, Floats]:
    """Return offsets of bars along the sections [px], NaN without one, and their variances [px^2].

    Of several bars in a section, the strong one near its middle counts.
    """
    contrast = 6.0  # of paint above the grass on either side [levels of 255]
    count = len(sections.places)
    candidates, strengths = np.empty((count, CANDIDATES)), np.empty((count, CANDIDATES))
    find_bars(picture, sections, np.full(count, reach), contrast, candidates, strengths)
    with np.errstate(divide="ignore"):
        merit = np.log(strengths) - 0.5 * (2.0 * candidates / reach) ** 2
    best = np.where(np.isnan(candidates), -np.inf, merit).argmax(axis=1)
    offsets, variances = np.empty(count), np.empty(count)
    chosen = candidates[np.arange(count), best]
    fit_bars(picture, sections, chosen, contrast, offsets, variances)
    return offsets, variances


def _select_near(camera: MovingCamera, lines: LineSamples) -> LineSamples:
    """Return the samples in or near the image of a pinhole camera without distortion."""
    local = (lines.points_world - camera.center) @ camera.rotation[0].T
    ahead = local[:, 2] > 1.0
    place = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
    half = 0.6 * camera.image_size / camera.focal[0]
    shift = (camera.principal_point - 0.5 * camera.image_size) / camera.focal[0]
    return lines[ahead & (np.abs(place + shift) < half).all(axis=-1)]


def _find_hidden(places: Floats, people: Floats, reach: float) -> Flags:
    """Return a mask of the places (n,) in or near a person's box."""
    x, y = places[:, 0, None], places[:, 1, None]
    x0, y0, x1, y1 = people.T
    with np.errstate(invalid="ignore"):
        across = (x > x0 - reach) & (x < x1 + reach)
        return np.asarray((across & (y > y0 - reach) & (y < y1 + reach)).any(axis=1))


def _correct_camera(camera: MovingCamera, lines: PointEvidence, weight: float) -> MovingCamera:
    """Return a single frame with rotation and focal length fitted to its lines."""
    std = np.array([3e-3, 3e-3, 1.5e-3, 4e-3])  # prior of the step [rad, 1]
    begin, step = camera, np.zeros(4)
    across = lines.whitening / np.linalg.norm(lines.whitening, axis=(1, 2))[:, None, None]
    for scale in (12.0, 6.0, 3.0, 1.5, 1.0):
        system = ArrowSystem.zeros(1, FRAME_SIZE, CLIP_SIZE)
        scaled = replace(lines, whitening=across / scale, loss=np.ones(len(lines)))
        points = scaled.arrays(np.full_like(lines.ends, -1))
        field_residuals(camera, np.zeros((0, 3)), points, weight, system)
        normal = system.blocks[0, 0, :4, :4] + np.diag(1.0 / std**2)
        step = step - np.linalg.solve(normal, system.right[0, :4] + step / std**2)
        camera = begin.take_step(np.append(step, np.zeros(3))[None], np.zeros(5))
    return camera


def follow_lines(
    camera: MovingCamera,
    samples: FieldSamples,
    pictures: Iterable[Image],
    boxes: Floats | None,
    settings: BroadcastCalibrationSettings,
) -> tuple[PointEvidence, MovingCamera, Integers]:
    """Return the painted lines of all grey images in order, and the cameras corrected by them.

    Each frame's correction initializes the next. Boxes (frames, detections, 4) [px] of people
    occlude lines; None = no people. The last value (n, 3) has the frame before `find_lines`'s.
    """
    parts, cameras, searched = [], [], []
    before = after = camera.frames(slice(0, 1))
    for frame, picture in enumerate(pictures):
        single = camera.frames(slice(frame, frame + 1))
        turn = after.rotation @ np.swapaxes(before.rotation, -1, -2)
        begin = replace(
            single, rotation=turn @ single.rotation, focal=single.focal * after.focal / before.focal
        )
        people = None if boxes is None else boxes[frame]
        found, corrected, seen = find_lines(begin, samples, picture, people, settings)
        searched.append(np.insert(seen, 0, frame, axis=1))
        parts.append(found.in_frame(frame))
        cameras.append(corrected)
        before, after = single, corrected
    return join_evidence(parts), join_cameras(cameras), np.concatenate(searched)
