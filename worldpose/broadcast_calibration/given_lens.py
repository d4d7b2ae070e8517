"""Rotations of a clip with a given lens in every frame and a given pose of the first frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from data_contracts.arrays import Floats, Image
from worldpose.broadcast_calibration.cuts import require_one_shot
from worldpose.broadcast_calibration.evidence import FlowEvidence, PointEvidence
from worldpose.broadcast_calibration.line_evidence import FieldSamples, follow_lines
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.optical_flow import follow
from worldpose.broadcast_calibration.priors import prior_of
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.solving import Problem, solve
from worldpose.broadcast_calibration.turning import modified_z_scores, turn_only
from worldpose.broadcast_calibration.uncertainty import Uncertainty, uncertainty_of
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate


def follow_given_lens(
    camera: MovingCamera,
    pictures: Callable[[], Iterator[Image]],
    *,
    pitch: PitchTemplate | None = None,
    boxes: Floats | None = None,
    settings: BroadcastCalibrationSettings = BroadcastCalibrationSettings(),  # noqa: B008
    where: str = "broadcast clip",
) -> tuple[MovingCamera, Uncertainty]:
    """Return the rotations of a clip from its focal lengths, distortion and first pose.

    This is the setting of the public challenge: K and k for every frame, R and t of the first one.

    Args:
        camera: all frames; the function uses the first frame's rotation and every frame's lens.
        pictures: starts a new pass over the clip's grey frames.
        pitch: also detect its painted lines; None = followed points alone.
        boxes: (frames, detections, 4) [px] of moving people in the frames; None = no people.
        settings: weights and noise.
        where: clip or file, for messages.

    Raises:
        InputError: the clip has cuts, or its frame count differs from the camera's.
    """
    followed = follow(pictures(), boxes, settings.flow_points)
    if len(followed) + 1 != len(camera):
        raise InputError(
            where,
            expected=f"{len(camera)} frames, as the lens is known for",
            found=f"{len(followed) + 1}",
            todo="Give the clip that the cameras belong to.",
        )
    require_one_shot(followed, settings.cut_share, where)
    rotation = camera.rotation.copy()
    pairs, starts, ends, off = [], [], [], []
    for pair, points in enumerate(followed):
        two = replace(camera, rotation=rotation).frames(slice(pair, pair + 2))
        turned = turn_only(two, points)
        rotation[pair + 1] = turned.camera.rotation[1]
        with np.errstate(invalid="ignore"):
            kept = modified_z_scores(turned.residual) < settings.flow_outlier
        pairs.append(np.full(int(kept.sum()), pair))
        starts.append(points.start[kept])
        ends.append(points.end[kept])
        off.append(turned.residual[kept])
    tracked = replace(camera, rotation=rotation)
    residual = np.concatenate([np.empty((0, 2)), *off])
    seen = 1.4826 * float(np.median(np.abs(residual))) if len(residual) else 0.0
    flow = FlowEvidence(
        np.concatenate([np.empty(0, dtype=np.int64), *pairs]),
        np.concatenate([np.empty((0, 2)), *starts]),
        np.concatenate([np.empty((0, 2)), *ends]),
        np.full(len(residual), max(seen, settings.flow_noise)),
    )
    lines = PointEvidence.none()
    if pitch is not None:
        found = follow_lines(tracked, FieldSamples.of(pitch), pictures(), boxes, settings)
        lines = found.evidence
        # Keep the given lens.
        tracked = replace(tracked, rotation=found.camera.rotation)
    known = np.zeros((len(camera), FRAME_SIZE), dtype=np.bool_)
    known[0] = True
    tracked = replace(tracked, rotation=np.concatenate([camera.rotation[:1], tracked.rotation[1:]]))
    independent = seen * np.sqrt(4.0 / max(settings.flow_points, 1))
    problem = Problem(
        points=lines,
        flow=flow,
        prior=prior_of(settings.prior, camera.focal, camera.image_size),
        smoothness=np.append(np.full(3, 2e-3), np.full(FRAME_SIZE - 3, np.inf)),
        flow_weight=min(1.0, (independent / settings.flow_drift) ** 2),
        flow_loss=settings.loss,
        free_frame=np.arange(FRAME_SIZE) < 3,
        free_clip=np.zeros(CLIP_SIZE, dtype=np.bool_),
        known=known,
    )
    solution = solve(tracked, problem, settings.iterations)
    return solution.camera, uncertainty_of(solution, problem, settings.line_shift)
