"""Task of stage `redetection`: second search for missed people in one clip of one video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.redetection import REDETECTION
from data_contracts.work import Recipe, Work
from tasks.clip_inputs import ADJUSTED
from tasks.detection import footage_index, require_weights
from tasks.triangulation import load_triangulation_settings
from tasks.unit import open_input, require_registered, unit_task
from worldpose.body_fitting.objective import perceived_joints
from worldpose.detection.models import load_pose, load_score_map
from worldpose.detection.pipeline import Place
from worldpose.detection.settings import DetectionSettings, RedetectionSettings
from worldpose.filtering.judging import (
    BodyViews,
    Spread,
    TriangulatedDetections,
    learn_keypoint_spread,
    perceived_covariance,
    view_bodies,
)
from worldpose.filtering.systematic_errors import SystematicErrors, ViewBias, watch_motion
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.pitch.template import PitchTemplate
from worldpose.redetection import (
    Expected,
    MissingPeople,
    Verdicts,
    find_detected_people,
    judge_search_results,
    search_missing_people,
    select_missing_people,
)
from worldpose.review.identities import select_triangulated
from worldpose.store.store import Store
from worldpose.video.folder import open_video, some_pictures

FEW: Final = 500
"""Minimum number of keypoints to estimate a camera's spread; below it the stated one is used
[1]."""


@unit_task
def redetection(work: Work) -> str:
    """Publish the camera's people, including redetected ones; return the key."""
    store = Store.open(work.project)
    settings = RedetectionSettings.model_validate(work.recipe.settings)
    with store.publish(work) as result:
        case = _open(store, work)
        sought = case.select_missing_people(settings)
        found = _search(store, work, case, sought)
        verdicts = judge_search_results(
            found,
            sought,
            case.expected,
            case.detected,
            case.spread,
            case.noise,
            settings,
        )
        result.write(
            REDETECTION,
            arrays=_arrays(case, sought, found, verdicts),
            coordinates={"frame": case.detected.frame},
            attributes={
                "camera_id": work.recipe.sources["camera"],
                **case.detected.labels(),
            },
        )
        for name in ("found", "unsure", "elsewhere", "another"):
            result.figures[name] = float(np.count_nonzero(getattr(verdicts, name)))
        result.figures |= {"sought": float(len(sought.frame)), "hidden": float(sought.hidden)}
    return work.key


@dataclass(frozen=True, eq=False)
class _Case:
    """A clip in one camera, and the bodies of the previous iteration.

    Attributes:
        camera: after adjustment to people.
        surface: crown and end fall of the pitch that the cameras show [m]; None = as in pitch.json.
        detection: recipe of the detection.
        detected: the people of `detection` (frames, detections).
        person: (persons,) ids.
        expected: the bodies in the camera's images.
        shift: (frames, persons, 17, 2) [px], systematic error of keypoints relative to joints.
        seen: (frames, persons), detected people; all people in corrected frames.
        spread: spread of the camera's keypoints around the bodies.
        noise: stated keypoint noise, [px] and [m].
    """

    camera: Camera
    surface: list[float] | None
    detection: Recipe
    detected: KeypointDetections
    person: NDArray[np.integer]
    expected: Expected
    shift: NDArray[np.float64]
    seen: NDArray[np.bool_]
    spread: Spread
    noise: tuple[float, float]

    def select_missing_people(self, settings: RedetectionSettings) -> MissingPeople:
        """Return visible people without a detection; none if disabled."""
        pitch = self.detection.sources["pitch"]
        place = None
        if pitch is not None:
            template = PitchTemplate.from_spec(PitchSpec.model_validate(pitch))
            if self.surface is not None:
                template = template.with_surface(self.surface)
            place = Place(self.camera, template)
        width, height = (int(side) for side in self.camera.image_size)
        return select_missing_people(
            self.expected,
            self.seen | (not settings.enabled),
            (width, height),
            settings,
            place,
            DetectionSettings.model_validate(self.detection.settings).pitch_margin_m,
        )


def _open(store: Store, work: Work) -> _Case:
    sources: dict[str, Any] = work.recipe.sources
    name, clip = sources["camera"], sources["clip"]
    unit, inputs = work.recipe.unit, work.recipe.inputs
    detected = KeypointDetections.from_arrays(open_input(store, work, f"detection/{unit}"))
    manifest = store.manifest(work.recipe.match_id, "detection", unit, inputs[f"detection/{unit}"])
    tracks = select_triangulated(open_input(store, work, f"tracking/{clip}"))
    place = tracks["camera"].values.tolist().index(name)
    adjusted = open_input(store, work, ADJUSTED)
    camera = camera_from_arrays(adjusted.data_vars)[place]
    one = Camera.stack([camera])
    (bodies,) = (
        open_input(store, work, f"{stage}/{clip}")
        for stage in ("refitting", "body_fitting")
        if f"{stage}/{clip}" in inputs
    )
    placed = open_input(store, work, f"retriangulation/{clip}").isel(camera=slice(place, place + 1))
    said = open_input(store, work, f"filtering/{clip}")
    joints = perceived_joints(bodies["joints"].values, bodies["joint_offsets"].values)
    sure = perceived_covariance(bodies["covariance"].values, placed["common_bias"].values)
    views = view_bodies(one, joints, sure)
    step = np.gradient(joints, axis=0) if len(joints) > 1 else np.zeros_like(joints)
    systematic = SystematicErrors(
        ViewBias(said["view_bias"].values), said["clock_late"].values[[place]]
    )
    shift = systematic.shift(watch_motion(one, joints, step), views)
    offsets = placed["offsets"].values.astype(np.float64)
    beside = shift[:, 0] + offsets[:, 0, :, None]

    count = detected.score.shape[1]  # indices from here on: earlier redetections
    index = tracks["detection_index"].values[:, place]
    fits, dropped = (said[name].values[:, place, :count] for name in ("fits", "dropped"))
    seen = find_detected_people(index, fits, dropped)
    edits: Any = manifest.recipe.sources.get("edits", [])
    seen[np.isin(detected.frame, [edit["frame"] for edit in edits])] = True
    noise = load_triangulation_settings(store, work.recipe, clip).noise
    suspects = TriangulatedDetections(
        KeypointDetections.from_keypoints(
            detected.keypoints[:, None].astype(np.float64),
            detected.confidence[:, None].astype(np.float64),
            np.where(index < count, index, -1)[:, None],
        ),
        offsets,
        placed["exchanged"].values,
        dropped[:, None],
        noise,
    )
    return _Case(
        camera=camera,
        surface=adjusted.attrs["surface"],
        detection=manifest.recipe,
        detected=detected,
        person=tracks["person"].values,
        expected=Expected.of(views, beside, float(camera.focal.mean())),
        shift=np.nan_to_num(shift[:, 0]),
        seen=seen,
        spread=_spread(views, suspects.subtract(shift)),
        noise=noise,
    )


def _spread(views: BodyViews, suspects: TriangulatedDetections) -> Spread:
    """Estimate the keypoint spread around bodies; the stated one if there are too few keypoints."""
    if np.count_nonzero(suspects.detections.detection_index >= 0) * len(COCO17) < FEW:
        return Spread(np.ones(len(COCO17)), np.empty(0), np.ones(1))
    return learn_keypoint_spread(views, suspects)


def _search(store: Store, work: Work, case: _Case, sought: MissingPeople) -> KeypointDetections:
    """Run the pose net of `detection` where people are expected."""
    settings = DetectionSettings.model_validate(case.detection.settings)
    sources: dict[str, Any] = case.detection.sources
    if not len(sought.frame):
        return KeypointDetections.empty()
    require_weights(settings, sources["weights"])
    shown = _pictures(store, work, case, np.unique(sought.frame))
    found = search_missing_people(
        shown,
        sought,
        load_pose(settings),
        settings.min_keypoint_confidence,
        case.detected.boxes,
    )
    require_registered(Path(work.folder) / sources["video"], sources["video_sha256"])
    score_map = load_score_map(settings)
    return found if score_map is None else replace(found, score=score_map.probability(found.score))


def _pictures(
    store: Store, work: Work, case: _Case, places: NDArray[np.int64]
) -> Iterator[tuple[int, Image | None]]:
    """Yield the images of some frame indices in order, without those that the video lacks.

    Decoding skips images without a search.
    """
    sources: dict[str, Any] = case.detection.sources
    footage = open_input(store, work, f"ingest/{work.recipe.sources['camera']}")
    numbers = footage["picture_of_frame"].sel(frame=case.detected.frame[places]).values
    there = numbers >= 0
    place_of = dict(zip(numbers[there].tolist(), places[there].tolist(), strict=True))
    with open_video(Path(work.folder) / sources["video"], footage_index(footage)) as video:
        for number, picture in some_pictures(video, numbers[there]):
            yield place_of[number], picture


def _arrays(
    case: _Case, sought: MissingPeople, results: KeypointDetections, verdicts: Verdicts
) -> dict[str, NDArray[Any]]:
    """Return all detections at their indices, followed by the redetected people."""
    before = case.detected.arrays()
    frames, count = case.detected.score.shape
    (found,) = np.nonzero(verdicts.found)
    frame = sought.frame[found]
    behind = np.arange(len(found)) - np.searchsorted(frame, frame)
    more = int(behind.max(initial=-1)) + 1
    arrays: dict[str, NDArray[Any]] = {
        name: np.pad(
            values,
            [(0, 0), (0, more)] + [(0, 0)] * (values.ndim - 2),
            constant_values=np.nan,
        )
        for name, values in before.items()
    }
    shape = (frames, count + more)
    arrays["found_again"] = np.full(shape, -1, dtype=np.int32)
    arrays["shift"] = np.zeros((*shape, len(COCO17), 2), dtype=np.float32)
    at = frame, count + behind
    wrong = verdicts.rejected[found]
    arrays["keypoints"][at] = np.where(wrong[..., None], np.nan, results.keypoints[found])
    arrays["confidence"][at] = np.where(wrong, np.nan, results.confidence[found])
    arrays["boxes"][at] = results.boxes[found]
    arrays["score"][at] = results.score[found]
    arrays["found_again"][at] = case.person[sought.person[found]]
    arrays["shift"][at] = case.shift[frame, sought.person[found]]
    return arrays
