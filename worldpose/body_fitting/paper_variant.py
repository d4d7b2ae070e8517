"""Body fitting with `method=paper`, in the records of this stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import torch

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17, COCO17_TORSO
from data_contracts.keypoints import TrackedFrames
from worldpose.body.differentiable import DifferentiableBody
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.estimate import long_gaps, split_windows
from worldpose.body_fitting.results import BodyFit, EvidenceSource, FittedArrays
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.geometry.cameras import Camera
from worldpose.reference_method.body_fitting import fit_person
from worldpose.reference_method.cameras import TensorCameras


def fit_in_windows(
    model: BodyModel,
    evidence: EvidenceSource,
    seen: tuple[Camera, TrackedFrames],
    settings: BodyFittingSettings,
    known_shapes: Mapping[int, Shape],
) -> Iterator[tuple[slice, BodyFit]]:
    """Yield the paper's bodies for consecutive frames, as `estimate.fit_in_windows` yields ours.

    A person's shape is that of its first window. The paper states no covariance: that of a person's
    joints is the mean square distance to the triangulated joints, and that of the betas is their
    prior's. `seen` are static cameras (cameras,) and the detections of the tracked people.
    """
    cameras, body = TensorCameras.of(seen[0]), DifferentiableBody(fold_keypoints(model, COCO17))
    shapes = {person: shape.betas for person, shape in known_shapes.items()}
    for window, kept in split_windows(evidence.size[0], evidence.fps, settings):
        joints = evidence.read_joints(window).joints
        image = seen[1][window].by_person()[0].astype(np.float64)
        arrays = FittedArrays.empty(model, *joints.shape[:2])
        for person in range(joints.shape[1]):
            pixels = image[:, :, person]
            _fit(body, cameras, joints[:, person], pixels, shapes, arrays, person)
            known = np.asarray(np.isfinite(joints[:, person]).any((1, 2)))
            gone = long_gaps(known, settings.max_filled_gap_s * evidence.fps)
            arrays.drop(person, slice(0, len(joints)), gone)
        betas = np.broadcast_to(arrays.betas, (len(joints), *arrays.betas.shape))
        fit = BodyFit(
            arrays.betas,
            BodyParameters(betas, arrays.orient, arrays.body_pose, arrays.transl),
            arrays.betas_covariance,
            arrays.joints,
            arrays.covariance,
            arrays.filled,
            arrays.guided,
            np.zeros((len(COCO17), 3)),
        )
        yield kept, fit[slice(kept.start - window.start, kept.stop - window.start)]


def _fit(
    body: DifferentiableBody,
    cameras: TensorCameras,
    joints: Floats,
    image: Floats,
    shapes: dict[int, Floats],
    arrays: FittedArrays,
    person: int,
) -> None:
    """Write one person's bodies from the first frame with joints to the last."""
    if (betas := shapes.get(person)) is not None:
        arrays.betas[person], arrays.betas_covariance[person] = betas, np.eye(len(betas))
    usable = np.isfinite(joints[:, COCO17_TORSO, 0]).sum(-1) >= 3
    if not usable.any():
        return
    here = np.flatnonzero(np.isfinite(joints).any((1, 2)))
    span = slice(here[0], here[-1] + 1)
    omega = fit_person(body, joints[span], cameras, torch.tensor(image[span]), betas)
    shapes[person] = arrays.betas[person] = omega.betas.numpy()
    arrays.betas_covariance[person] = np.eye(len(omega.betas))
    for array, values in zip(
        (arrays.orient, arrays.body_pose, arrays.transl), omega[1:], strict=True
    ):
        array[span, person] = values.numpy()
    arrays.joints[span, person] = found = body.keypoints(*omega).numpy()
    arrays.covariance[span, person] = np.eye(3) * np.nanmean((found - joints[span]) ** 2)
    arrays.filled[span, person] = ~np.isfinite(joints[span]).any((1, 2))
