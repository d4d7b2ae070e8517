"""Task of stage `refitting`: bodies refitted with the broadcast camera and other clips' shapes.

Without static cameras: bodies of the people that the broadcast camera alone films.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.refitting import REFITTING
from data_contracts.work import Work
from tasks.body_fitting import fit_people, open_people, publish_fit
from tasks.plane_bodies import publish_plane_bodies
from tasks.unit import open_input, require_registered, unit_task
from worldpose.body_fitting import (
    BodyFittingSettings,
    MonocularPoses,
    RayConstraints,
    Shape,
    constrain_to_rays,
    identify_people,
    place_monocular_poses,
    pool_shapes,
    read_monocular,
    shift_frames,
)
from worldpose.geometry import Camera
from worldpose.geometry.cameras import camera_from_arrays
from worldpose.store import Store

KNOWN: Final = 2.0
"""Frames with a larger expected reprojection error of players are left out [px]. Keypoint errors
are as large, but they differ between the keypoints of one person."""


@unit_task
def refitting(work: Work) -> str:
    """Publish bodies and their keypoints; return the key."""
    store = Store.open(work.project)
    unit = work.recipe.unit
    if f"broadcast_tracking/{unit}" in work.recipe.inputs:
        with store.publish(work) as result:
            publish_plane_bodies(store, work, result)
        return work.key
    before = store.manifest(
        work.recipe.match_id, "body_fitting", unit, work.recipe.inputs[f"body_fitting/{unit}"]
    ).recipe
    with store.publish(work) as result:
        people = open_people(store, work)
        joints = open_input(store, work, f"body_fitting/{unit}")["joints"].values
        views: list[RayConstraints] = []
        monocular_poses: MonocularPoses | None = None
        if f"broadcast_calibration/{unit}" in work.recipe.inputs:
            pictures = _pictures(store, work, people.detections.frame)
            views = [_view(store, work, pictures, joints)]
            monocular_poses = _read_monocular_poses(work, pictures, joints)
        weight = BodyFittingSettings.model_validate(before.settings).shape_weight
        known = _known_shapes(store, work, people.person, weight)
        model, fit = fit_people(
            people, before, views=views, monocular_poses=monocular_poses, known=known
        )
        recognised = views[0].seen if views else np.zeros(joints.shape[:2], dtype=bool)
        pooled = np.isin(np.arange(len(people.person)), list(known))
        further = {"recognised": recognised, "pooled": pooled}
        publish_fit(result, REFITTING, people, model, fit, further, {"without_body": {}})
        moved = np.linalg.norm(fit.joints - joints, axis=-1)
        result.figures["recognised"] = float(recognised.sum())
        result.figures["pooled"] = float(pooled.sum())
        for place, person in enumerate(people.person):
            if np.isfinite(moved[:, place]).any():
                figure = float(np.nanmedian(moved[:, place]))
                result.figures[f"moved_m.person{person}"] = figure
    return work.key


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Images of a clip's broadcast camera, one per frame of the clip.

    Attributes:
        number: (frames,) index of each image in its video.
        camera: batch (frames,); NaN if too uncertain.
        late: clock offset of the images relative to the frames [frame].
    """

    number: NDArray[np.int64]
    camera: Camera
    late: float


def _pictures(store: Store, work: Work, frame: NDArray[np.int64]) -> _Pictures:
    sources: dict[str, Any] = work.recipe.sources
    name = f"broadcast_calibration/{work.recipe.unit}"
    found = open_input(store, work, name)
    pooled = f"broadcast_pooling/{work.recipe.unit}"
    best = open_input(store, work, pooled) if pooled in work.recipe.inputs else found
    camera = camera_from_arrays(best.data_vars)
    known = found["reprojection_error"].values <= KNOWN
    offset = float(sources["broadcast_offset_frames"])
    late = round(offset) - offset
    stage, unit = name.split("/")
    key = work.recipe.inputs[name]
    calibrated = store.manifest(work.recipe.match_id, stage, unit, key).recipe
    measured = (found.attrs["feed_offset"] or {}).get("frames")
    if calibrated.settings["feed_offset"] == "correct" and measured is not None:
        late += measured
    return _Pictures(
        number=frame + sources["offset_frames"],
        camera=replace(camera, focal=np.where(known[:, None], camera.focal, np.nan)),
        late=late,
    )


def _view(store: Store, work: Work, pictures: _Pictures, joints: Floats) -> RayConstraints:
    """Return the ray constraints of the broadcast camera's 2D poses."""
    sources: dict[str, Any] = work.recipe.sources
    first, count = sources["first_frame"], sources["frame_count"]
    seen = open_input(store, work, sources["seen_in_broadcast"]).sel(
        frame=np.arange(first, first + count)
    )
    then = shift_frames(joints, pictures.late)
    keypoints = seen["keypoints"].values.astype(np.float64)
    own = identify_people(pictures.camera, keypoints, then)
    view = constrain_to_rays(pictures.camera, own, then)
    return RayConstraints(
        shift_frames(view.points, -pictures.late), shift_frames(view.across, -pictures.late)
    )


def _read_monocular_poses(work: Work, pictures: _Pictures, joints: Floats) -> MonocularPoses | None:
    """Return the monocular poses of the images, if there are any."""
    sources: dict[str, Any] = work.recipe.sources
    if sources["estimates"] is None:
        return None
    path = Path(work.folder) / sources["estimates"]
    estimates = read_monocular(path)
    require_registered(path, sources["estimates_sha256"])
    then = shift_frames(joints, pictures.late)
    seen = place_monocular_poses(estimates, pictures.camera, pictures.number, then)
    whole = -round(pictures.late)
    return MonocularPoses(shift_frames(seen.orient, whole), shift_frames(seen.angles, whole))


def _known_shapes(
    store: Store, work: Work, persons: NDArray[np.integer], weight: float
) -> dict[int, Shape]:
    """Return the body shapes from other clips, by person index.

    Args:
        store: the store.
        work: the current work order.
        persons: ids of this clip's people.
        weight: weight of the betas' normal prior, common to the bodies of all clips [1].
    """
    sources: dict[str, Any] = work.recipe.sources
    named: dict[str, dict[str, str]] = dict(sources["people"])
    here = named.pop(work.recipe.unit)
    shapes: dict[str, list[Shape]] = {}
    for clip, people in named.items():
        found = open_input(store, work, f"body_fitting/{clip}")
        for place, person in enumerate(found["person"].values):
            betas = found["betas"].values[place]
            if str(person) in people and np.isfinite(betas).all():
                shape = Shape(betas, found["betas_covariance"].values[place])
                shapes.setdefault(people[str(person)], []).append(shape)
    return {
        place: pool_shapes(shapes[here[str(person)]], weight)
        for place, person in enumerate(persons)
        if here.get(str(person)) in shapes
    }
