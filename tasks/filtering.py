"""Tasks of stages `filtering` and `redetection`: one clip's detections compared with its bodies.

`redetection` searches for missed people in one clip of one video.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Floats, Image
from data_contracts.conventions import COCO17
from data_contracts.detection import REDETECTION
from data_contracts.filtering import FILTERING
from data_contracts.keypoints import KeypointDetections
from tasks.clip_inputs import (
    ADJUSTED,
    ClipInputs,
    PagedArray,
    known_changes,
    load_dropped_boxes,
    open_tracked_clip,
    triangulation_settings,
)
from tasks.detection import footage_index, require_weights
from tasks.unit import UnitInputs, unit_task
from worldpose.body_fitting.evidence import perceived_joints, random_covariance
from worldpose.compiled import map_in_threads
from worldpose.detection.models import load_pose, load_score_map
from worldpose.detection.pipeline import Place
from worldpose.detection.settings import DetectionSettings, RedetectionSettings
from worldpose.detection.turning import QuarterTurn
from worldpose.filtering.held_out import measure_held_out
from worldpose.filtering.judging import (
    BodyViews,
    Judgement,
    Spread,
    TriangulatedDetections,
    judge_detections,
    learn_keypoint_spread,
    view_bodies,
)
from worldpose.filtering.redetection import (
    Expected,
    MissingPeople,
    Verdicts,
    find_detected_people,
    judge_search_results,
    search_missing_people,
    select_missing_people,
)
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.systematic_errors import (
    BodyMotion,
    SystematicErrors,
    ViewBias,
    learn_systematic_errors,
    watch_motion,
)
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.ingest.clock import remaining_offset
from worldpose.review.identities import select_triangulated
from worldpose.store.writer import ResultWriter
from worldpose.triangulation.camera_changes import correct_views, move_on
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.video.folder import open_video, some_pictures

PART = 64
"""Frames per part: 100 MB with 25 people and 16 cameras, for each of up to five at a time."""
PLACED = ("offsets", "exchanged")
"""Arrays of `retriangulation` that describe the detections."""
_Frames = slice | NDArray[np.int64]
_Part = tuple[slice, TriangulatedDetections]


@unit_task
def filtering(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the keypoints and boxes that the bodies reject."""
    settings, case = inputs.settings(FilteringSettings), _open_case(inputs)
    frame, camera_ids = case.clip.detections.frame, case.clip.camera_ids
    most = min(len(frame), settings.max_held_out_frames)
    chosen = np.unique(np.linspace(0, len(frame) - 1, most).astype(np.int64))
    (views, motion), suspects = case.project(chosen), case.read(chosen)
    fps = case.clip.fps * len(chosen) / len(frame)
    joints, _, _ = case.bodies.read(chosen)
    systematic = learn_systematic_errors(
        case.clip.cameras, joints, views, motion, suspects, settings, fps
    )
    held = np.zeros(len(camera_ids))
    if case.first:
        held = systematic.clock_offsets_in(suspects.offsets, motion)
    placed = suspects.subtract_clock_offsets(held, motion.image_motion)
    spread = learn_keypoint_spread(views, placed.subtract(systematic.shift(motion, views)))
    counts, rejected = np.zeros(5), np.zeros((2, len(camera_ids)))

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
        return arrays, *_counts(judged, suspects)

    with inputs.open_spool() as spool:
        # Read here: two threads would both read the page in which their parts meet.
        for arrays, some, by_camera in map_in_threads(judge, case.parts()):
            spool.add(arrays)
            counts += some
            rejected += by_camera
        bias = systematic.view_bias.coefficient
        result.write(
            FILTERING,
            arrays=spool.arrays() | {"view_bias": bias, "clock_late": systematic.late},
            coordinates={"frame": frame, "person": case.bodies.person},
            attributes={"camera": list(camera_ids)},
        )
    names = ("judged", "keypoints_rejected", "boxes_dropped", "boxes_of_others", "boxes_found")
    figures = {name: float(count) for name, count in zip(names, counts, strict=True)}
    for c, camera in enumerate(camera_ids):
        figures[f"rejected_share.{camera}"] = float(rejected[0, c] / max(rejected[1, c], 1.0))
        figures[f"clock_late_frames.{camera}"] = float(systematic.late[c])
    figures["view_bias_m"] = float(np.sqrt((bias**2).mean()))
    result.figures.update(figures | _held_out(inputs, case, chosen, suspects))


class _Bodies:
    """Fitted bodies of a clip, of ids `person` (persons,), read by frames."""

    def __init__(self, fitted: xr.Dataset, common_bias: Floats) -> None:
        self.person: NDArray[np.integer] = fitted["person"].values
        self._joints, self._covariance = (
            PagedArray.of(fitted[name]) for name in ("joints", "covariance")
        )
        self._offsets: Floats = fitted["joint_offsets"].values
        self._common_bias = common_bias

    def read(self, frames: _Frames) -> tuple[Floats, Floats, Floats]:
        """Return joints, motion and covariance in some frames.

        Body joints by the detector's definition (frames, persons, 17, 3) [m] are in the world.
        Their motion per frame has that shape, NaN if unknown; the covariance is (frames, persons,
        17, 3, 3) [m^2].
        """
        last = self._joints.shape[0] - 1
        rows = np.arange(last + 1)[frames]
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, last)
        read = np.unique(np.concatenate([before, rows, after]))
        joints = perceived_joints(self._joints[read], self._offsets)
        step = joints[np.searchsorted(read, after)] - joints[np.searchsorted(read, before)]
        step /= np.maximum(after - before, 1)[:, None, None, None]
        covariance = self._covariance[rows]
        return (
            joints[np.searchsorted(read, rows)],
            step,
            random_covariance(covariance, self._common_bias),
        )


@dataclass(frozen=True, eq=False)
class _Case:
    """A clip with its fitted bodies, read in chunks.

    Attributes:
        clip: all detections, without earlier rejections, of tracked people.
        placed: arrays `PLACED` of `retriangulation`.
        dropped: (frames, cameras, detections), boxes that the previous iteration dropped; None in
            the first.
    """

    clip: ClipInputs
    bodies: _Bodies
    placed: Mapping[str, PagedArray]
    dropped: NDArray[np.bool_] | None
    triangulation: TriangulationSettings

    @property
    def first(self) -> bool:
        """Whether this is the first iteration, without shifted keypoints."""
        return self.dropped is None

    def parts(self) -> Iterator[_Part]:
        """Yield all frames, `PART` at a time, with their detections."""
        count = len(self.clip.detections.frame)
        for first in range(0, count, PART):
            frames = slice(first, min(first + PART, count))
            yield frames, self.read(frames)

    def project(self, frames: _Frames) -> tuple[BodyViews, BodyMotion]:
        """Return the bodies, and their motion, in all images."""
        joints, step, covariance = self.bodies.read(frames)
        motion = watch_motion(self.clip.cameras, joints, step)
        return view_bodies(self.clip.cameras, joints, covariance), motion

    def read(self, frames: _Frames) -> TriangulatedDetections:
        """Return the detections to test, with results of their triangulation."""
        offsets, exchanged = (self.placed[name][frames] for name in PLACED)
        detections = self.clip.detections[frames]
        boxes = detections.confidence.shape[:3]
        before = np.zeros(boxes, dtype=np.bool_) if self.dropped is None else self.dropped[frames]
        return TriangulatedDetections(
            detections, offsets.astype(np.float64), exchanged, before, self.triangulation.noise
        )


def _open_case(inputs: UnitInputs) -> _Case:
    unit = inputs.unit
    bodies = inputs.open_first(f"refitting/{unit}", f"body_fitting/{unit}")
    placed = inputs.open(f"retriangulation/{unit}")
    return _Case(
        clip=open_tracked_clip(inputs, without=("rejected", "shift")),
        bodies=_Bodies(bodies, placed["common_bias"].values),
        placed={name: PagedArray.of(placed[name]) for name in PLACED},
        dropped=load_dropped_boxes(inputs),
        triangulation=triangulation_settings(inputs, unit),
    )


def _counts(
    judged: Judgement, suspects: TriangulatedDetections
) -> tuple[list[float], list[Floats]]:
    """Count keypoints tested and rejected; boxes dropped, reassigned, and newly assigned.

    Also return the keypoints rejected and given by camera.
    """
    frame, camera, person = np.nonzero(suspects.detections.detection_index >= 0)
    taken = np.full(judged.fits.shape, -1)
    taken[frame, camera, suspects.detections.detection_index[frame, camera, person]] = person
    moved = (judged.fits >= 0) & (judged.fits != taken)
    counts = [
        float(np.isfinite(judged.mahalanobis_distance).sum()),
        float(judged.rejected.sum()),
        float(judged.dropped.sum()),
        float((moved & (taken >= 0)).sum()),
        float((moved & (taken < 0)).sum()),
    ]
    given = np.isfinite(suspects.detections.confidence)
    return counts, [judged.rejected.sum(axis=(0, 2, 3)), given.sum(axis=(0, 2, 3))]


def _held_out(
    inputs: UnitInputs, case: _Case, frames: NDArray[np.int64], suspects: TriangulatedDetections
) -> dict[str, float]:
    """Measure the held-out error of cameras from the keypoints that this iteration uses.

    The systematic errors of cameras are estimated in every iteration, and redetected people are not
    evaluated, so that iterations are comparable.
    """
    used, keypoints = suspects.detections, suspects.detections.keypoints
    if not case.first:
        used = open_tracked_clip(inputs).detections[frames]
        whole = open_tracked_clip(inputs, without=("rejected", "redetected"))
        keypoints = whole.detections.keypoints[frames]
    found = measure_held_out(case.clip.cameras, used, keypoints, case.triangulation)
    if found is None:
        return {}
    return {"held_out_error": found.error, "held_out_keypoints": float(found.keypoints)}


@unit_task
def redetection(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the camera's people, including redetected ones."""
    settings = inputs.settings(RedetectionSettings)
    case = _open_view(inputs)
    sought = case.select_missing_people(settings)
    found = _search(inputs, case, sought)
    verdicts = judge_search_results(
        found, sought, case.expected, case.detected, case.spread, case.noise, settings
    )
    result.write(
        REDETECTION,
        arrays=_arrays(case, sought, found, verdicts),
        coordinates={"frame": case.detected.frame},
        attributes={"camera_id": inputs.sources["camera"], **case.detected.labels()},
    )
    for name in ("found", "unsure", "elsewhere", "another"):
        result.figures[name] = float(np.count_nonzero(getattr(verdicts, name)))
    result.figures |= {"sought": float(len(sought.frame)), "hidden": float(sought.hidden)}


@dataclass(frozen=True, eq=False)
class _CameraCase:
    """A clip in one camera, and the bodies of the previous iteration.

    Attributes:
        camera: after adjustment to people.
        surface: crown and end fall of the pitch that the cameras show [m]; None = as in pitch.json.
        detection: what the detections were computed from.
        detected: the people of `detection` (frames, detections).
        expected: the bodies in the camera's images, which follow its changes; NaN if left out.
        shift: (frames, persons, 17, 2) [px], systematic error of keypoints relative to joints.
        seen: (frames, persons), detected people; all people in corrected frames.
        spread: spread of the camera's keypoints around the bodies.
        noise: stated keypoint noise, [px] and [m].
    """

    camera: Camera
    surface: list[float] | None
    detection: UnitInputs
    detected: KeypointDetections
    person: NDArray[np.integer]
    expected: Expected
    shift: NDArray[np.float64]
    seen: NDArray[np.bool_]
    spread: Spread
    noise: tuple[float, float]

    def select_missing_people(self, settings: RedetectionSettings) -> MissingPeople:
        """Return visible people without a detection; none if disabled."""
        pitch, place = self.detection.pitch, None
        if pitch is not None:
            raised = pitch if self.surface is None else pitch.with_surface(self.surface)
            place = Place(self.camera, raised)
        width, height = (int(side) for side in self.camera.image_size)
        return select_missing_people(
            self.expected,
            self.seen | (not settings.enabled),
            (width, height),
            settings,
            place,
            self.detection.settings(DetectionSettings).pitch_margin_m,
        )


def _open_view(inputs: UnitInputs) -> _CameraCase:
    name, clip = inputs.sources["camera"], inputs.sources["clip"]
    detected = KeypointDetections.from_arrays(inputs.open(f"detection/{inputs.unit}"))
    detection = inputs.made_from(f"detection/{inputs.unit}")
    tracks = select_triangulated(inputs.open(f"tracking/{clip}"))
    place = tracks["camera"].values.tolist().index(name)
    adjusted = inputs.open(ADJUSTED)
    camera = camera_from_arrays(adjusted.data_vars)[place]
    one = Camera.stack([camera])
    bodies = inputs.open_first(f"refitting/{clip}", f"body_fitting/{clip}")
    placed = inputs.open(f"retriangulation/{clip}").isel(camera=slice(place, place + 1))
    said = inputs.open(f"filtering/{clip}")
    joints, step, covariance = _Bodies(bodies, placed["common_bias"].values).read(slice(None))
    views = view_bodies(one, joints, covariance)
    systematic = SystematicErrors(
        ViewBias(said["view_bias"].values), said["clock_late"].values[[place]]
    )
    motion = watch_motion(one, joints, step)
    shift = systematic.shift(motion, views)
    offsets = placed["offsets"].values.astype(np.float64)
    clocks, frame = inputs.made_from(f"tracking/{clip}").sources.get("clocks"), detected.frame
    late = np.zeros(1) if clocks is None else remaining_offset(frame, *clocks[place])
    in_image = shift + late[:, None, None, None, None] * motion.image_motion
    beside = in_image[:, 0] + offsets[:, 0, :, None]

    count = detected.score.shape[1]  # indices from here on: earlier redetections
    index = tracks["detection_index"].values[:, place]
    fits, dropped = (said[name].values[:, place, :count] for name in ("fits", "dropped"))
    seen = find_detected_people(index, fits, dropped)
    seen[np.isin(frame, [edit["frame"] for edit in detection.sources.get("edits", [])])] = True
    noise = triangulation_settings(inputs, clip).noise
    known = known_changes(inputs, clip)
    changes = [each for each in known if (each.camera, each.kind) == (name, "view")]
    suspects = TriangulatedDetections(
        KeypointDetections.from_keypoints(
            correct_views(detected.keypoints[:, None], frame, {name: camera}, changes),
            detected.confidence[:, None].astype(np.float64),
            np.where(index < count, index, -1)[:, None],
        ),
        offsets,
        placed["exchanged"].values,
        dropped[:, None],
        noise,
    )
    expected = Expected.of(views, beside, float(camera.focal.mean()))
    return _CameraCase(
        camera=camera,
        surface=adjusted.attrs["surface"],
        detection=detection,
        detected=detected,
        person=tracks["person"].values,
        expected=replace(expected, image=move_on(expected.image, frame, camera, changes)),
        shift=np.nan_to_num(shift[:, 0]),
        seen=seen,
        spread=_spread(views, suspects.subtract(in_image)),
        noise=noise,
    )


def _spread(views: BodyViews, suspects: TriangulatedDetections) -> Spread:
    """Estimate the keypoint spread around bodies; the stated one if there are too few keypoints."""
    few = 500  # keypoints
    if np.count_nonzero(suspects.detections.detection_index >= 0) * len(COCO17) < few:
        return Spread(np.ones(len(COCO17)), np.empty(0), np.ones(1))
    return learn_keypoint_spread(views, suspects)


def _search(inputs: UnitInputs, case: _CameraCase, sought: MissingPeople) -> KeypointDetections:
    """Run the pose net of `detection` where people are expected."""
    settings = case.detection.settings(DetectionSettings)
    if not len(sought.frame):
        return KeypointDetections.empty()
    require_weights(settings, case.detection.sources["weights"])
    shown = _pictures(inputs, case, np.unique(sought.frame))
    boxes: AnyFloats = case.detected.boxes
    # As in `detection`.
    quarters = round(inputs.manifest(f"detection/{inputs.unit}").figures["turned_deg"] / 90.0)
    width, height = case.camera.image_size.tolist()
    turn = QuarterTurn(quarters, (width, height)) if quarters else None
    if turn is not None:
        shown = ((place, turn.image(image)) for place, image in shown)
        sought, boxes = replace(sought, boxes=turn.boxes(sought.boxes)), turn.boxes(boxes)
    pose, least = load_pose(settings), settings.min_keypoint_confidence
    found = search_missing_people(shown, sought, pose, least, boxes)
    found = found if turn is None else turn.turn_back(found)
    case.detection.require_registered("video")
    score_map = None if "boxes" in case.detection.sources else load_score_map(settings)
    return found if score_map is None else replace(found, score=score_map.probability(found.score))


def _pictures(
    inputs: UnitInputs, case: _CameraCase, places: NDArray[np.int64]
) -> Iterator[tuple[int, Image | None]]:
    """Yield the images of some frame indices, as the video has them, without those it lacks."""
    footage = inputs.open(f"ingest/{inputs.sources['camera']}")
    numbers = footage["picture_of_frame"].sel(frame=case.detected.frame[places]).values
    there = numbers >= 0
    with open_video(case.detection.file("video"), footage_index(footage)) as video:
        for number, picture in some_pictures(video, np.unique(numbers[there])):
            # Several frames show one image of a camera with a lower frame rate than the match's.
            yield from ((place, picture) for place in places[numbers == number].tolist())


def _arrays(
    case: _CameraCase, sought: MissingPeople, results: KeypointDetections, verdicts: Verdicts
) -> dict[str, NDArray[Any]]:
    """Return all detections at their indices, followed by the redetected people."""
    frames, count = case.detected.score.shape
    (found,) = np.nonzero(verdicts.found)
    frame = sought.frame[found]
    behind = np.arange(len(found)) - np.searchsorted(frame, frame)
    more = int(behind.max(initial=-1)) + 1
    arrays: dict[str, NDArray[Any]] = {
        name: np.pad(
            values, [(0, 0), (0, more)] + [(0, 0)] * (values.ndim - 2), constant_values=np.nan
        )
        for name, values in case.detected.arrays().items()
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
