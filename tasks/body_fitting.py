"""Task of stage `body_fitting`: a body for every person of one clip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import Floats, GroupLayout
from data_contracts.body_fitting import BODY_FITTING
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.work import Recipe, Work
from tasks.clip_inputs import ClipInputs, open_clip
from tasks.triangulation import camera_errors, load_triangulation_settings
from tasks.unit import figures_of, open_input, unit_task
from worldpose.body import BodyModel, digest_of_body, find_body
from worldpose.body_fitting import (
    BodyFit,
    BodyFittingSettings,
    ClipEvidence,
    Ground,
    MonocularPoses,
    RayConstraints,
    SeenClip,
    Shape,
    compare_held_out,
    far_offsets,
    find_ray_constraints,
    fit_bodies,
    report_fit,
)
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.review.identities import select_triangulated
from worldpose.store import ResultWriter, Store
from worldpose.triangulation import ExtraJoints, undo_swaps


@unit_task
def body_fitting(work: Work) -> str:
    """Publish bodies and their keypoints; return the key."""
    store = Store.open(work.project)
    with store.publish(work) as result:
        people = open_people(store, work)
        model, fit = fit_people(people, work.recipe)
        publish_fit(result, BODY_FITTING, people, model, fit)
        result.figures.update(_compare_with_joints(store, work, people, fit))
    return work.key


def _compare_with_joints(
    store: Store, work: Work, people: ClipPeople, fit: BodyFit
) -> dict[str, float]:
    """Return the metrics of fitted against triangulated joints in held-out cameras."""
    recipe, unit = work.recipe, work.recipe.unit
    placed = store.manifest(
        recipe.match_id, "retriangulation", unit, recipe.inputs[f"retriangulation/{unit}"]
    )
    clip = people.clip
    held_out = compare_held_out(
        *_fitting_basis(people, recipe),
        SeenClip(
            clip.cameras,
            camera_errors(work, clip),
            people.detections,
            load_triangulation_settings(store, placed.recipe, unit),
            clip.fps,
        ),
        fit,
    )
    return {} if held_out is None else held_out.figures()


@dataclass(frozen=True, eq=False)
class ClipPeople:
    """Observations of the people of one clip by the static cameras.

    Attributes:
        clip: cameras, frames and clock.
        detections: detections of these people, as triangulated: left-right swaps are undone.
        person: (persons,) ids.
        joints: (frames, persons, 17, 3) [m], world, triangulated.
        covariance: (frames, persons, 17, 3, 3) [m^2].
        shared_covariance: (frames, persons, 3, 3) [m^2], the part of it that moves all joints
            together.
        common_bias: (17,) per axis, systematic error shared by all views [m]; in `covariance`.
        extra: points besides COCO-17, triangulated; None without any.
    """

    clip: ClipInputs
    detections: KeypointDetections
    person: NDArray[np.integer]
    joints: Floats
    covariance: Floats
    shared_covariance: Floats
    common_bias: Floats
    extra: ExtraJoints | None


def open_people(store: Store, work: Work) -> ClipPeople:
    """Read the tracked and triangulated people of the clip of `work`."""
    clip = open_clip(store, work)
    placed = open_input(store, work, f"retriangulation/{work.recipe.unit}")
    tracks = select_triangulated(open_input(store, work, f"tracking/{work.recipe.unit}"))
    detections = clip.detections[:].assign_people(tracks["detection_index"].values)
    return ClipPeople(
        clip,
        undo_swaps(detections, placed["exchanged"].values),
        placed["person"].values,
        placed["joints"].values,
        placed["covariance"].values,
        placed["shared_covariance"].values,
        placed["common_bias"].values,
        extra_joints(placed),
    )


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


def fit_people(
    people: ClipPeople,
    recipe: Recipe,
    *,
    views: Sequence[RayConstraints] = (),
    monocular_poses: MonocularPoses | None = None,
    known: Mapping[int, Shape] | None = None,
) -> tuple[BodyModel, BodyFit]:
    """Fit a clip's bodies.

    Args:
        people: people of the clip.
        recipe: recipe of this stage: its settings, body model and pitch.
        views: ray constraints of further cameras.
        monocular_poses: monocular poses (S4).
        known: shapes from other clips, by person index.
    """
    model, settings, ground = _fitting_basis(people, recipe)
    alone = find_ray_constraints(people.clip.cameras, people.detections, people.joints)
    fit = fit_bodies(
        model,
        ClipEvidence(
            people.joints,
            people.covariance,
            people.clip.fps,
            ray_constraints=[alone, *views],
            monocular_poses=monocular_poses,
            common_bias=people.common_bias,
            shared_covariance=people.shared_covariance,
            extra=people.extra,
        ),
        settings,
        ground,
        known_shapes=known,
    )
    return model, fit


def _fitting_basis(
    people: ClipPeople, recipe: Recipe
) -> tuple[BodyModel, BodyFittingSettings, Ground | None]:
    """Return the body model, the settings and the ground of a recipe."""
    sources: dict[str, Any] = recipe.sources
    pitch = sources["pitch"]
    ground = None
    if pitch is not None:
        template = PitchTemplate.from_spec(PitchSpec.model_validate(pitch))
        ground = people.clip.raise_pitch(template).height
    settings = BodyFittingSettings.model_validate(recipe.settings)
    return find_same_body(settings.body_model, sources["body_model_sha256"]), settings, ground


def publish_fit(
    result: ResultWriter,
    layout: GroupLayout,
    people: ClipPeople,
    model: BodyModel,
    fit: BodyFit,
    further: Mapping[str, NDArray[Any]] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write bodies, the arrays in `further`, the group's other attributes, and their metrics."""
    extra: dict[str, NDArray[Any]] = {}
    points: dict[str, list[str]] = {}
    if fit.extra is not None:
        points = {"point": list(fit.extra.points)}
        extra = {
            "extra_joints": fit.extra.joints,
            "extra_covariance": fit.extra.covariance,
            "extra_offsets": fit.extra.offsets,
        }
    result.write(
        layout,
        arrays={
            "betas": fit.betas,
            "betas_covariance": fit.betas_covariance,
            "global_orient": fit.parameters.global_orient,
            "body_pose": fit.parameters.body_pose,
            "transl": fit.parameters.transl,
            "joints": fit.joints,
            "covariance": fit.covariance,
            "filled": fit.filled,
            "guided": fit.guided,
            "joint_offsets": fit.offsets,
            **extra,
            **(further or {}),
        },
        coordinates={"frame": people.detections.frame, "person": people.person},
        attributes={"body_model": model.name, **points, **(attributes or {})},
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
    static = people.clip.cameras, people.detections
    report = report_fit(fit, people.joints, people.clip.fps, static)
    result.figures.update(figures_of(report, [f"person{person}" for person in people.person]))


def find_same_body(name: str, sha256: str | None) -> BodyModel:
    """Return the body model of the run plan."""
    if sha256 is not None and digest_of_body(name) != sha256:
        raise InputError(
            f"body model {name}",
            expected="the file that the run was planned with",
            found="another",
            todo="Install the same body model on all workers, and run again.",
        )
    return find_body(name)
