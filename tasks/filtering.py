"""Task of stage `filtering`: comparison of one clip's detections with its bodies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.filtering import FILTERING
from data_contracts.work import Work
from tasks.clip_inputs import ChunkedRows, ClipInputs, load_dropped_boxes, open_clip, read_rows
from tasks.spool import open_spool
from tasks.triangulation import load_triangulation_settings
from tasks.unit import open_input, unit_task
from worldpose.body_fitting.objective import perceived_joints
from worldpose.compiled import map_in_threads
from worldpose.filtering.held_out import measure_held_out
from worldpose.filtering.judging import (
    BodyViews,
    Judgement,
    TriangulatedDetections,
    judge_detections,
    learn_keypoint_spread,
    perceived_covariance,
    view_bodies,
)
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.systematic_errors import BodyMotion, learn_systematic_errors, watch_motion
from worldpose.review.identities import select_triangulated
from worldpose.store.store import Store
from worldpose.triangulation.settings import TriangulationSettings

PART = 64
"""Frames per part: 100 MB with 25 people and 16 cameras, for each of up to five at a time."""
PLACED = ("offsets", "exchanged")
"""Arrays of `retriangulation` that describe the detections."""
_Frames = slice | NDArray[np.int64]
_Part = tuple[slice, TriangulatedDetections]


@unit_task
def filtering(work: Work) -> str:
    """Publish the keypoints and boxes that the bodies reject; return the key."""
    store = Store.open(work.project)
    settings = FilteringSettings.model_validate(work.recipe.settings)
    with store.publish(work) as result, open_spool(store) as spool:
        case = _open(store, work)
        chosen = _evenly(len(case.clip.detections.frame), settings.max_held_out_frames)
        views, motion, suspects = case.at(chosen)
        systematic = learn_systematic_errors(
            case.clip.cameras,
            case.bodies.read(chosen)[0],
            views,
            motion,
            suspects,
            settings,
            case.clip.fps * len(chosen) / len(case.clip.detections.frame),
        )
        held = np.zeros(len(case.clip.camera_ids))
        if case.first:
            held = systematic.clock_offsets_in(suspects.offsets, motion)
        placed = suspects.subtract_clock_offsets(held, motion.image_motion)
        spread = learn_keypoint_spread(views, placed.subtract(systematic.shift(motion, views)))
        counts = np.zeros(5)
        rejected = np.zeros((2, len(case.clip.camera_ids)))

        def judge(part: _Part) -> tuple[dict[str, NDArray[Any]], list[float], list[Floats]]:
            frames, suspects = part
            views, motion = case.project(frames)
            shift = systematic.shift(motion, views)
            placed = suspects.subtract_clock_offsets(held, motion.image_motion)
            judged = judge_detections(views, placed.subtract(shift), spread, settings)
            arrays = {
                "rejected": judged.rejected,
                "surprise": judged.mahalanobis_distance,
                "dropped": judged.dropped,
                "fits": judged.fits,
                "similarity": judged.similarity,
                "shift": suspects.assign_to_detections(shift).astype(np.float32),
            }
            by_camera = [
                judged.rejected.sum(axis=(0, 2, 3)),
                np.isfinite(suspects.detections.confidence).sum(axis=(0, 2, 3)),
            ]
            return arrays, _counts(judged, suspects), by_camera

        # Read here: two threads would both read the page in which their parts meet.
        for arrays, some, by_camera in map_in_threads(judge, case.parts()):
            spool.add(arrays)
            counts += some
            rejected += by_camera
        result.write(
            FILTERING,
            arrays=spool.arrays()
            | {"view_bias": systematic.view_bias.coefficient, "clock_late": systematic.late},
            coordinates={"frame": case.clip.detections.frame, "person": case.bodies.person},
            attributes={"camera": list(case.clip.camera_ids)},
        )
        names = ("judged", "keypoints_rejected", "boxes_dropped", "boxes_of_others", "boxes_found")
        figures = {name: float(count) for name, count in zip(names, counts, strict=True)}
        for c, camera in enumerate(case.clip.camera_ids):
            figures[f"rejected_share.{camera}"] = float(rejected[0, c] / max(rejected[1, c], 1.0))
            figures[f"clock_late_frames.{camera}"] = float(systematic.late[c])
        figures["view_bias_m"] = float(np.sqrt((systematic.view_bias.coefficient**2).mean()))
        result.figures.update(figures | _held_out(store, work, case, chosen, suspects))
    return work.key


class _Bodies:
    """Fitted bodies of a clip, read by frames.

    Attributes:
        person: (persons,) ids.
    """

    def __init__(self, fitted: xr.Dataset, common_bias: Floats) -> None:
        self.person: NDArray[np.integer] = fitted["person"].values
        self._fitted = fitted
        self._offsets: Floats = fitted["joint_offsets"].values
        self._common_bias = common_bias

    def read(self, frames: _Frames) -> tuple[Floats, Floats, Floats]:
        """Return joints, motion and covariance in some frames.

        Returns:
            Body joints by the detector's definition (frames, persons, 17, 3) [m], world; their
            motion per frame (frames, persons, 17, 3) [m], NaN if unknown; the covariance of the
            joints (frames, persons, 17, 3, 3) [m^2].
        """
        last = self._fitted.sizes["frame"] - 1
        rows = np.arange(last + 1)[frames]
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, last)
        read = np.unique(np.concatenate([before, rows, after]))
        joints = perceived_joints(read_rows(self._fitted["joints"], read), self._offsets)
        step = joints[np.searchsorted(read, after)] - joints[np.searchsorted(read, before)]
        step /= np.maximum(after - before, 1)[:, None, None, None]
        covariance = read_rows(self._fitted["covariance"], rows)
        return (
            joints[np.searchsorted(read, rows)],
            step,
            perceived_covariance(covariance, self._common_bias),
        )


@dataclass(frozen=True, eq=False)
class _Case:
    """A clip with its fitted bodies, read in chunks.

    Attributes:
        clip: all detections, without earlier rejections, of tracked people.
        bodies: the bodies.
        placed: result of `retriangulation`.
        dropped: (frames, cameras, detections), boxes that the previous iteration dropped; None in
            the first.
        triangulation: settings of the triangulation.
    """

    clip: ClipInputs
    bodies: _Bodies
    placed: xr.Dataset
    dropped: NDArray[np.bool_] | None
    triangulation: TriangulationSettings

    @property
    def first(self) -> bool:
        """Whether this is the first iteration, without shifted keypoints."""
        return self.dropped is None

    def at(self, frames: NDArray[np.int64]) -> tuple[BodyViews, BodyMotion, TriangulatedDetections]:
        """Project the bodies into all images; return views, motion, and the detections to test."""
        offsets, exchanged = (read_rows(self.placed[name], frames) for name in PLACED)
        views, motion = self.project(frames)
        return views, motion, self.read(frames, offsets, exchanged)

    def parts(self) -> Iterator[_Part]:
        """Yield all frames, `PART` at a time, with their detections."""
        count = len(self.clip.detections.frame)
        placed = [ChunkedRows(self.placed[name]) for name in PLACED]
        for first in range(0, count, PART):
            frames = slice(first, min(first + PART, count))
            yield frames, self.read(frames, *(array[frames] for array in placed))

    def project(self, frames: _Frames) -> tuple[BodyViews, BodyMotion]:
        """Return the bodies, and their motion, in all images."""
        joints, step, covariance = self.bodies.read(frames)
        motion = watch_motion(self.clip.cameras, joints, step)
        return view_bodies(self.clip.cameras, joints, covariance), motion

    def read(
        self, frames: _Frames, offsets: NDArray[Any], exchanged: NDArray[Any]
    ) -> TriangulatedDetections:
        """Return the detections to test, with these results of their triangulation."""
        detections = self.clip.detections[frames]
        boxes = detections.confidence.shape[:3]
        before = np.zeros(boxes, dtype=np.bool_) if self.dropped is None else self.dropped[frames]
        return TriangulatedDetections(
            detections,
            offsets.astype(np.float64),
            exchanged,
            before,
            self.triangulation.noise,
        )


def _open(store: Store, work: Work) -> _Case:
    unit = work.recipe.unit
    tracks = select_triangulated(open_input(store, work, f"tracking/{unit}"))
    (bodies,) = (
        open_input(store, work, name)
        for name in (f"refitting/{unit}", f"body_fitting/{unit}")
        if name in work.recipe.inputs
    )
    placed = open_input(store, work, f"retriangulation/{unit}")
    return _Case(
        clip=open_clip(store, work, filtered=False, shifted=False).assign_people(
            tracks["detection_index"].values
        ),
        bodies=_Bodies(bodies, placed["common_bias"].values),
        placed=placed,
        dropped=load_dropped_boxes(store, work),
        triangulation=load_triangulation_settings(store, work.recipe, unit),
    )


def _counts(judged: Judgement, suspects: TriangulatedDetections) -> list[float]:
    """Count keypoints tested and rejected; boxes dropped, reassigned, and newly assigned."""
    frame, camera, person = np.nonzero(suspects.detections.detection_index >= 0)
    taken = np.full(judged.fits.shape, -1)
    taken[frame, camera, suspects.detections.detection_index[frame, camera, person]] = person
    moved = (judged.fits >= 0) & (judged.fits != taken)
    return [
        float(np.isfinite(judged.mahalanobis_distance).sum()),
        float(judged.rejected.sum()),
        float(judged.dropped.sum()),
        float((moved & (taken >= 0)).sum()),
        float((moved & (taken < 0)).sum()),
    ]


def _held_out(
    store: Store,
    work: Work,
    case: _Case,
    frames: NDArray[np.int64],
    suspects: TriangulatedDetections,
) -> dict[str, float]:
    """Measure the held-out error of cameras from the keypoints that this iteration uses.

    The systematic errors of cameras are estimated in every iteration, and redetected people are not
    evaluated, so that iterations are comparable.

    Args:
        store: the store.
        work: the current work order.
        case: the clip and its bodies.
        frames: the frames to measure in.
        suspects: their detections.
    """
    used = suspects.detections
    keypoints = used.keypoints
    if not case.first:
        clip = open_clip(store, work).assign_people(case.clip.detections.detection_index)
        used = clip.detections[frames]
        whole = open_clip(store, work, filtered=False, redetected=False)
        keypoints = whole.detections.keypoints[frames]
    found = measure_held_out(case.clip.cameras, used, keypoints, case.triangulation)
    if found is None:
        return {}
    return {"held_out_error": found.error, "held_out_keypoints": float(found.keypoints)}


def _evenly(frames: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` evenly spaced frames."""
    return np.unique(np.linspace(0, frames - 1, min(frames, most)).astype(np.int64))
