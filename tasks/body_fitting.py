"""Task of stage `body_fitting`: a body for every person of one clip."""

from __future__ import annotations

from typing import Any

from data_contracts.body_fitting import BODY_FITTING
from data_contracts.pitch import PitchSpec
from data_contracts.run import Work
from tasks.clip_inputs import open_clip
from tasks.unit import figures_of, open_input, unit_task
from worldpose.body import BodyModel, digest_of_body, find_body
from worldpose.body_fitting import (
    BodyFittingSettings,
    Pictures,
    find_sightings,
    fit_bodies,
    report_fit,
)
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.store import Store


@unit_task
def body_fitting(work: Work) -> str:
    """Publishes bodies and their keypoints; returns the key."""
    store = Store.open(work.project)
    sources: dict[str, Any] = work.recipe.sources
    pitch = sources["pitch"]
    ground = None
    if pitch is not None:
        ground = PitchTemplate.from_spec(PitchSpec.model_validate(pitch)).height
    settings = BodyFittingSettings.model_validate(work.recipe.settings)
    model = _body(settings.body_model, sources["body_model_sha256"])
    with store.publishing(work) as result:
        clip = open_clip(store, work)
        keypoints = clip.keypoints[:]
        index = open_input(store, work, f"tracking/{work.recipe.unit}")["detection_index"].values
        placed = open_input(store, work, f"retriangulation/{work.recipe.unit}")
        joints = placed["joints"].values
        fit = fit_bodies(
            model,
            joints,
            placed["covariance"].values,
            clip.fps,
            settings,
            ground,
            sightings=find_sightings(clip.cameras, keypoints, index, joints),
        )
        result.write(
            BODY_FITTING,
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
            },
            coordinates={"frame": clip.frame, "person": placed["person"].values},
            attributes={"body_model": model.name},
        )
        persons = [f"person{person}" for person in placed["person"].values]
        report = report_fit(fit, joints, clip.fps, Pictures(clip.cameras, keypoints, index))
        result.figures.update(figures_of(report, persons))
    return work.key


def _body(name: str, sha256: str | None) -> BodyModel:
    """The body model that was planned with."""
    if sha256 is not None and digest_of_body(name) != sha256:
        raise InputError(
            f"body model {name}",
            expected="the file that the run was planned with",
            found="another",
            todo="Install the same body model on all workers, and run again.",
        )
    return find_body(name)
