"""Task of stage `refitting`: bodies refitted with the broadcast camera and other clips' shapes.

Without static cameras: bodies of the people that the broadcast camera alone films.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.body_fitting import REFITTING
from data_contracts.keypoints import KeypointDetections
from tasks.body_fitting import ClipPeople, FurtherArrays, find_same_body, frame_arrays, write_fit
from tasks.broadcast_calibration import BroadcastInputs, image_clock, open_broadcast
from tasks.clip_inputs import select_frames
from tasks.unit import UnitInputs, figures_of, unit_task
from worldpose.body_fitting.bones import Shape, agree, pool_shapes
from worldpose.body_fitting.monocular import (
    MonocularEstimates,
    MonocularPoses,
    place_monocular_poses,
    read_monocular,
)
from worldpose.body_fitting.plane_bodies import PlaneEvidence, fit_bodies_on_plane
from worldpose.body_fitting.ray_constraints import (
    RayConstraints,
    constrain_to_rays,
    identify_people,
)
from worldpose.body_fitting.report import report_fit
from worldpose.body_fitting.results import BodyFit, ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.broadcast_calibration.uncertainty import static_covariance
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.ingest.clock import ImageClock, camera_frames
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.ground_error import surface_motion
from worldpose.store.writer import ResultWriter

KNOWN: Final = 2.0
"""Frames with a larger expected reprojection error of players are left out [px]. Keypoint errors
are as large, but they differ between the keypoints of one person."""


@unit_task
def refitting(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write bodies and their keypoints."""
    if f"broadcast_tracking/{inputs.unit}" in inputs:
        _write_plane_bodies(inputs, result)
    else:
        _refit(inputs, result)


def _refit(inputs: UnitInputs, result: ResultWriter) -> None:
    """Fit the bodies of triangulated people again, with all that is known of them."""
    unit = inputs.unit
    before = inputs.made_from(f"body_fitting/{unit}")
    fitted = inputs.open(f"body_fitting/{unit}")
    stage = "broadcast_calibration/"
    names = sorted(name for name in inputs.recipe.inputs if name.startswith(stage))
    views = [_RefittedView.open(inputs, name.removeprefix(stage), fitted) for name in names]
    people = ClipPeople(inputs, views)
    known = _known_shapes(inputs, before, fitted, result)
    pooled = np.isin(np.arange(len(people.person)), list(known))
    recognised = 0
    moved: list[list[Floats]] = [[] for _ in people.person]

    def further(part: slice, fit: BodyFit, evidence: ClipEvidence) -> dict[str, NDArray[Any]]:
        nonlocal recognised
        seen = np.zeros(fit.joints.shape[:2], dtype=np.bool_)
        for moving in evidence.ray_constraints[1:]:  # after those of static cameras
            seen |= moving.seen
        recognised += int(seen.sum())
        away = np.linalg.norm(fit.joints - fitted["joints"][part].values, axis=-1)
        for place, own in enumerate(moved):
            its = away[:: people.stride, place]
            own.append(its[np.isfinite(its)])
        return {"recognised": seen}

    others = FurtherArrays(further, {"pooled": pooled}, {"without_body": {}}, known)
    write_fit(inputs, result, REFITTING, people, before, others)
    result.figures["recognised"] = float(recognised)
    result.figures["pooled"] = float(pooled.sum())
    for person, own in zip(people.person, moved, strict=True):
        if any(map(len, own)):
            figure = float(np.median(np.concatenate(own)))
            result.figures[f"moved_m.person{person}"] = figure


@dataclass(frozen=True, eq=False)
class _RefittedView:
    """Images of a broadcast camera, one per frame of the clip, and what they show.

    Attributes:
        clock: the images of the frames.
        camera: batch (frames,); NaN if too uncertain.
        late: how much later than the clock says the images are [frame].
        keypoints: (frames, detections, 17, 2) [px], in the store.
        joints: (frames, persons, 17, 3) [m], world, fitted bodies' joints, in the store.
        estimates: monocular estimates; None without any.
    """

    clock: ImageClock
    camera: Camera
    late: float
    keypoints: xr.DataArray
    joints: xr.DataArray
    estimates: MonocularEstimates | None

    @classmethod
    def open(cls, inputs: UnitInputs, view: str, fitted: xr.Dataset) -> _RefittedView:
        """Open the images of a broadcast view of the unit's clip, whose bodies are `fitted`."""
        sources, name = inputs.sources, f"broadcast_calibration/{view}"
        ends = "" if view == inputs.unit else f".{view}"
        found = inputs.open(name)
        best = inputs.open_first(f"broadcast_pooling/{view}", name)
        camera = camera_from_arrays(best.data_vars)
        known = found["reprojection_error"].values <= KNOWN
        late = 0.0
        measured = (found.attrs["feed_offset"] or {}).get("frames")
        settings = inputs.made_from(name).recipe.settings
        if settings["feed_offset"] == "correct" and measured is not None:
            late = measured
        seen = select_frames(inputs.open(sources[f"seen_in_broadcast{ends}"]), inputs.frames)
        estimates = None
        if sources[f"estimates{ends}"] is not None:
            estimates = read_monocular(inputs.file(f"estimates{ends}"))
            inputs.require_registered(f"estimates{ends}")
        return cls(
            clock=image_clock(inputs, ends),
            camera=replace(camera, focal=np.where(known[:, None], camera.focal, np.nan)),
            late=late,
            keypoints=seen["keypoints"],
            joints=fitted["joints"],
            estimates=estimates,
        )

    def __call__(self, frames: slice) -> tuple[RayConstraints, MonocularPoses | None]:
        """Return the lines of sight and the monocular poses in some frames."""
        camera, clock = self.camera[frames], self.clock[frames]
        then = clock.to_images(self.joints[frames].values, self.late)
        own = identify_people(camera, self.keypoints[frames].values.astype(np.float64), then)
        view = constrain_to_rays(camera, own, then)
        rays = RayConstraints(
            clock.to_frames(view.points, self.late), clock.to_frames(view.across, self.late)
        )
        if self.estimates is None:
            return rays, None
        seen = place_monocular_poses(self.estimates, camera, clock.number, then)
        orient, angles, height = (
            clock.to_frames(each, self.late, whole=True)
            for each in (seen.orient, seen.angles, seen.height)
        )
        return rays, MonocularPoses(orient, angles, height)


def _known_shapes(
    inputs: UnitInputs, before: UnitInputs, fitted: xr.Dataset, result: ResultWriter
) -> dict[int, Shape]:
    """Return the body shapes from other clips that can be the same person's, by person index.

    `before` is what `fitted`, the bodies of this clip, were made from. The result gets a warning of
    every name of different people.
    """
    named: dict[str, dict[str, str]] = dict(inputs.sources["people"])
    here, own = named.pop(inputs.unit), _fitted_shapes(fitted)
    others = {clip: _fitted_shapes(inputs.open(f"body_fitting/{clip}")) for clip in named}
    model, weight = find_same_body(before), before.settings(BodyFittingSettings).prior_weight

    def stature(shape: Shape) -> str:
        height = model.template[:, 1] + model.shape_directions[:, 1] @ shape.betas
        return f"{np.ptp(height):.2f} m"

    known, ids = {}, fitted["person"].values.tolist()
    for person, name in here.items():
        if int(person) not in ids:  # tracked without a body, or told with the run's names
            continue
        shapes = []
        for clip, people in named.items():
            for other, shape in others[clip].items():
                if people.get(other) != name:
                    continue
                if person not in own or agree(own[person], shape):
                    shapes.append(shape)
                elif inputs.unit < clip:  # once for both
                    result.warnings.append(
                        f"person {person} of clip {inputs.unit} and person {other} of clip {clip} "
                        f"are both named {name} and differ: their bodies are "
                        f"{stature(own[person])} and {stature(shape)} tall. Neither gets the "
                        "other's shape: correct `people` in match.yaml."
                    )
        if shapes:
            known[ids.index(int(person))] = pool_shapes(shapes, [weight] * len(shapes))
    return known


def _fitted_shapes(bodies: xr.Dataset) -> dict[str, Shape]:
    """Return the known shapes of fitted bodies by person."""
    rows = bodies["person"].values, bodies["betas"].values, bodies["betas_covariance"].values
    return {
        str(person): Shape(betas, covariance)
        for person, betas, covariance in zip(*rows, strict=True)
        if np.isfinite(betas).all()
    }


def _write_plane_bodies(inputs: UnitInputs, result: ResultWriter) -> None:
    """Fit and write the bodies of the clip's people that the broadcast camera alone films."""
    estimates = read_monocular(inputs.file("estimates"))
    inputs.require_registered("estimates")
    model = find_same_body(inputs)
    filmed = open_broadcast(inputs)
    tracked = inputs.open(f"broadcast_tracking/{inputs.unit}")
    evidence = _observe_people(filmed, tracked, inputs.sources)
    bodies = fit_bodies_on_plane(model, evidence, estimates, filmed.pitch.height)
    persons = tracked["person"].values
    kept = np.array([reason is None for reason in bodies.missing], dtype=np.bool_)
    without = {
        str(person): reason
        for person, reason in zip(persons.tolist(), bodies.missing, strict=True)
        if reason is not None
    }
    fit = bodies.fit
    result.write(
        REFITTING,
        arrays={
            **{name: values[:, kept] for name, values in frame_arrays(fit).items()},
            "betas": fit.betas[kept],
            "betas_covariance": fit.betas_covariance[kept],
            "joint_offsets": fit.offsets,
            "recognised": np.asarray(bodies.views[:, kept].any(axis=-1)),
            "pooled": np.zeros(int(kept.sum()), dtype=np.bool_),
            "views": bodies.views[:, kept].astype(np.int16),
        },
        coordinates={"frame": tracked["frame"].values, "person": persons[kept]},
        attributes={"body_model": model.name, "without_body": without},
    )
    result.figures["without_body"] = float(len(without))
    _report_plane_bodies(result, fit, evidence, kept, persons)
    if without:
        told = "; ".join(f"person {person}: {reason}" for person, reason in without.items())
        result.warnings.append(
            f"{inputs.recipe.name}: {len(without)} of {len(persons)} people have a place on the "
            f"pitch and no body. {told}. Check {inputs.sources['estimates']} there: its frame "
            "numbers count the images of the clip's own video, and boxes are pixels of its images."
        )


def _observe_people(
    filmed: BroadcastInputs, tracked: xr.Dataset, sources: Mapping[str, Any]
) -> PlaneEvidence:
    """Return the keypoints of tracked people, and their places with covariance."""
    seen = filmed.detections
    index = tracked["detection_index"].values
    rows = np.arange(len(index))[:, None]
    found = index >= 0
    if seen.score.shape[1]:
        keypoints = np.where(found[..., None, None], seen.keypoints[rows, index], np.nan)
        confidence = np.where(found[..., None], seen.confidence[rows, index], np.nan)
    else:
        keypoints = np.full((*index.shape, 17, 2), np.nan)
        confidence = np.full((*index.shape, 17), np.nan)
    moving, uncertainty = filmed.camera
    place = tracked["ground"].values.astype(np.float64)
    return PlaneEvidence(
        camera=moving.camera,
        number=camera_frames(tracked["frame"].values, sources["offset_frames"], sources["rate"]),
        keypoints=keypoints.astype(np.float64),
        confidence=confidence.astype(np.float64),
        place=place,
        place_covariance=tracked["ground_covariance"].values.astype(np.float64),
        calibration=_calibration_covariance(
            moving.camera, static_covariance(moving, uncertainty), filmed.pitch, place
        ),
        fps=float(sources["fps"]),
    )


def _calibration_covariance(
    cameras: Camera, covariance: Floats, pitch: PitchTemplate, place: Floats
) -> Floats:
    """Return the covariance (frames, persons, 2, 2) [m^2] of places by the calibration alone.

    The places (frames, persons, 2) [m] lie on the pitch; `covariance` (frames, 12, 12) is that of
    each frame's camera.
    """
    out = np.zeros((*place.shape, 2))
    points = np.concatenate([place, pitch.height(place[..., 0], place[..., 1])[..., None]], axis=-1)
    for frame in range(len(place)):
        known = np.isfinite(place[frame, :, 0])
        if known.any() and np.isfinite(cameras.focal[frame]).all():
            motion = surface_motion(cameras[frame], pitch, points[frame, known])
            out[frame, known] = np.nan_to_num(motion @ covariance[frame] @ motion.swapaxes(1, 2))
    return out


def _report_plane_bodies(
    result: ResultWriter, fit: BodyFit, evidence: PlaneEvidence, kept: Flags, persons: Integers
) -> None:
    """Write the metrics of the bodies, named as those of triangulated people."""
    frames, count = evidence.place.shape[:2]
    own = np.broadcast_to(np.arange(count), (frames, 1, count))
    seen = KeypointDetections.from_keypoints(
        evidence.keypoints[:, None], evidence.confidence[:, None], own
    )
    report = report_fit(
        fit, np.full(fit.joints.shape, np.nan), evidence.fps, (evidence.camera[:, None], seen)
    )
    names = [f"person{person}" for person in persons]
    figures = figures_of(report, names)
    gone = {name for name, there in zip(names, kept, strict=True) if not there}
    result.figures |= {
        name: value for name, value in figures.items() if name.partition(".")[2] not in gone
    }
