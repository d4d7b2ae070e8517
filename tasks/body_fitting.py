"""Task of stage `body_fitting`: a body for every person of one clip."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import Floats, GroupLayout, Integers
from data_contracts.body_fitting import BODY_FITTING
from data_contracts.keypoints import KeypointDetections
from tasks.clip_inputs import PagedArray, open_tracked_clip, triangulation_settings
from tasks.triangulation import camera_errors
from tasks.unit import UnitInputs, figures_of, unit_task
from worldpose.body.body_file import find_body
from worldpose.body.model import BodyModel
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.estimate import fit_in_windows
from worldpose.body_fitting.evidence import Ground
from worldpose.body_fitting.held_out import SeenClip, compare_held_out
from worldpose.body_fitting.monocular import MonocularPoses, join_poses
from worldpose.body_fitting.ray_constraints import RayConstraints, find_ray_constraints
from worldpose.body_fitting.report import FitMetrics, far_offsets
from worldpose.body_fitting.results import BodyFit, ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.reference_method import require_torch
from worldpose.store.writer import ResultWriter
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.results import ExtraJoints

MEASURED_FRAMES: Final = 1000
"""Frames of a clip from which medians of metrics are computed."""


@unit_task
def body_fitting(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write bodies and their keypoints, and compare them with joints in held-out cameras."""
    people = ClipPeople(inputs)
    fit = write_fit(inputs, result, BODY_FITTING, people, inputs)
    if inputs.settings(BodyFittingSettings).method == "paper":
        return  # the comparison would refit our bodies
    clip, placed = people.clip, inputs.made_from(f"retriangulation/{inputs.unit}")
    settings = triangulation_settings(placed, inputs.unit)
    seen = SeenClip(clip.cameras, camera_errors(inputs, clip), people, settings, clip.fps)
    held_out = compare_held_out(*_fitting_basis(people, inputs), seen, fit)
    if held_out is not None:
        result.figures.update(held_out.figures())


Views = Callable[[slice], tuple[RayConstraints, MonocularPoses | None]]
"""Lines of sight and monocular poses of a moving camera in some frames."""


class ClipPeople:
    """Tracked and triangulated people of the unit's clip by the static cameras, read by frames.

    Attributes:
        person: (persons,) ids.
        common_bias: (17,) per axis, systematic error shared by all views [m]; in the covariance of
            joints.
    """

    def __init__(self, inputs: UnitInputs, views: Sequence[Views] = ()) -> None:
        placed = inputs.open(f"retriangulation/{inputs.unit}")
        self.clip = open_tracked_clip(inputs)
        self.person: NDArray[np.integer] = placed["person"].values
        self.common_bias: Floats = placed["common_bias"].values
        self.views = views
        self._placed = placed
        self._exchanged = PagedArray.of(placed["exchanged"])
        self._last: tuple[slice, ClipEvidence] | None = None
        self._whole: tuple[slice, ClipEvidence] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Number of frames and of persons."""
        return len(self.clip.detections.frame), len(self.person)

    @property
    def fps(self) -> float:
        """Frames per second of match time [1/s]."""
        return self.clip.fps

    @property
    def stride(self) -> int:
        """Of this many frames, medians of metrics use one."""
        return max(1, -(-self.size[0] // MEASURED_FRAMES))

    @property
    def detection_index(self) -> NDArray[np.integer]:
        """(frames, cameras, persons), each tracked person's detection; -1 = not seen."""
        return self.clip.detections.detection_index

    def __getitem__(self, frames: slice | Integers) -> KeypointDetections:
        """Return the detections in some frames, as triangulated: left-right swaps are undone."""
        rows = np.arange(self.size[0])[frames]
        return undo_swaps(self.clip.detections[rows], self._exchanged[rows])

    def read_joints(self, frames: slice) -> ClipEvidence:
        """Return the triangulated joints and points of some frames."""
        if (held := _part(self._last, frames)) is not None:
            return held
        self._last = self._whole = None  # else both windows would be in memory
        placed = self._placed.isel(frame=frames)
        evidence = ClipEvidence(
            placed["joints"].values,
            placed["covariance"].values,
            self.fps,
            common_bias=self.common_bias,
            shared_covariance=placed["shared_covariance"].values,
            extra=extra_joints(placed),
        )
        self._last = frames, evidence
        return evidence

    def read(self, frames: slice) -> ClipEvidence:
        """Return all evidence in some frames."""
        if (held := _part(self._whole, frames)) is None:
            placed = self.read_joints(frames)
            alone = find_ray_constraints(self.clip.cameras, _Frames(self, frames), placed.joints)
            moving = [view(frames) for view in self.views]
            rays = [alone, *(seen for seen, _ in moving)]
            monocular = join_poses([poses for _, poses in moving if poses is not None])
            held = replace(placed, ray_constraints=rays, monocular_poses=monocular)
            self._whole = frames, held
        return held


def _part(read: tuple[slice, ClipEvidence] | None, frames: slice) -> ClipEvidence | None:
    """Return some frames of what was read; None unless all of them were."""
    if read is None or frames.start < read[0].start or frames.stop > read[0].stop:
        return None
    first = read[0].start
    part = slice(frames.start - first, frames.stop - first)
    return read[1] if read[0] == frames else read[1].read(part)


@dataclass(frozen=True, eq=False)
class _Frames:
    """Detections of some frames of a clip, read when needed."""

    people: ClipPeople
    frames: slice

    @property
    def detection_index(self) -> NDArray[np.integer]:
        """(frames, cameras, persons), as of `ClipPeople`."""
        return self.people.detection_index[self.frames]

    def __getitem__(self, frames: slice | Integers) -> KeypointDetections:
        """Return the detections in some of these frames."""
        if isinstance(frames, slice):
            first = self.frames.start
            return self.people[slice(first + frames.start, first + frames.stop)]
        return self.people[self.frames.start + frames]


def extra_joints(placed: xr.Dataset) -> ExtraJoints | None:
    """Return the points besides COCO-17 of a result of triangulation; None without any."""
    if "extra_joints" not in placed:
        return None
    return ExtraJoints(
        tuple(placed["point"].values.tolist()),
        placed["extra_joints"].values,
        placed["extra_covariance"].values,
        placed["extra_views"].values,
        placed["extra_common_bias"].values,
    )


def _fitting_basis(
    people: ClipPeople, inputs: UnitInputs
) -> tuple[BodyModel, BodyFittingSettings, Ground | None]:
    """Return the body model, the settings and the ground of a fit."""
    pitch = people.clip.raise_pitch(inputs.pitch)
    ground = None if pitch is None else pitch.height
    return find_same_body(inputs), inputs.settings(BodyFittingSettings), ground


@dataclass
class FurtherArrays:
    """Arrays, also without frames, and attributes of a result besides those of bodies.

    Attributes:
        of_part: arrays of consecutive frames, given these, their bodies, and the evidence about
            them.
        known_shapes: shapes from other clips, by person index.
    """

    of_part: Callable[[slice, BodyFit, ClipEvidence], Mapping[str, NDArray[Any]]] = (
        lambda part, fit, evidence: {}
    )
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)
    known_shapes: Mapping[int, Shape] = field(default_factory=dict)


def write_fit(
    inputs: UnitInputs,
    result: ResultWriter,
    layout: GroupLayout,
    people: ClipPeople,
    fitting: UnitInputs,
    further: FurtherArrays = FurtherArrays(),  # noqa: B008
) -> BodyFit:
    """Fit the bodies of a clip in windows, and write them with their metrics.

    `fitting` is the unit of `body_fitting`, with settings, body model and pitch; `further` is what
    a result has besides bodies. Return shapes and offsets of the clip, without bodies of any frame.
    """
    model, settings, ground = _fitting_basis(people, fitting)
    metrics = FitMetrics(people.fps, people.stride)
    if settings.method == "paper":
        require_torch()
        from worldpose.body_fitting import paper_variant

        seen = (people.clip.cameras, people)
        windows = paper_variant.fit_in_windows(model, people, seen, settings, further.known_shapes)
    else:
        windows = fit_in_windows(model, people, settings, ground, further.known_shapes)
    with inputs.open_spool() as spool:
        for part, bodies in windows:
            spool.add(frame_arrays(bodies))
            evidence = people.read(part)
            spool.add(further.of_part(part, bodies, evidence))
            metrics.add(bodies, evidence.joints, (people.clip.cameras, _Frames(people, part)))
            fit = bodies[:0]
            del bodies, evidence  # while the next window is fitted
        whole = {
            "betas": fit.betas,
            "betas_covariance": fit.betas_covariance,
            "joint_offsets": fit.offsets,
        }
        points: dict[str, list[str]] = {}
        if fit.extra is not None:
            whole["extra_offsets"] = fit.extra.offsets
            points = {"point": list(fit.extra.points)}
        result.write(
            layout,
            arrays={**spool.arrays(), **whole, **further.arrays},
            coordinates={"frame": people.clip.detections.frame, "person": people.person},
            attributes={"body_model": model.name, **points, **further.attributes},
        )
    far = far_offsets(fit.offsets, people.common_bias)
    if far:
        joints = ", ".join(
            f"{name} {1e3 * length:.0f} mm (usually below {1e3 * most:.0f})"
            for name, (length, most) in far.items()
        )
        result.warnings.append(
            f"{layout.stage}: bodies lie far from the triangulated joints for the whole clip: "
            f"{joints}. One of the two is wrong there: compare both with the images, or export "
            "--stage retriangulation."
        )
    persons = [f"person{person}" for person in people.person]
    result.figures.update(figures_of(metrics.report(), persons))
    return fit


def frame_arrays(fit: BodyFit) -> dict[str, NDArray[Any]]:
    """Return the stored arrays with a frame dimension."""
    pose = ("global_orient", "body_pose", "transl")
    arrays: dict[str, NDArray[Any]] = {name: getattr(fit.parameters, name) for name in pose}
    for name in ("joints", "covariance", "filled", "guided"):
        arrays[name] = getattr(fit, name)
    if fit.extra is not None:
        arrays |= {"extra_joints": fit.extra.joints, "extra_covariance": fit.extra.covariance}
    return arrays


def find_same_body(inputs: UnitInputs) -> BodyModel:
    """Return the body model of a unit; UsageError without one, InputError if it is another."""
    folder = None if inputs.work.body_folder is None else Path(inputs.work.body_folder)
    name = str(inputs.recipe.settings["body_model"])
    return find_body(name, folder, inputs.sources["body_model_sha256"])
