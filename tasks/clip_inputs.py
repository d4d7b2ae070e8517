"""Synchronized frames of a match with the detections of all static cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import DTypeLike, NDArray

from data_contracts.arrays import AnyFloats, ClipArray, Flags, Integers, Singles
from data_contracts.detection import redetection_name
from data_contracts.keypoints import EXTRA_ARRAYS, KEYPOINT_ARRAYS, KeypointDetections
from data_contracts.triangulation import CameraChange
from tasks.unit import UnitInputs
from worldpose.filtering.feedback import Feedback, align_results, apply_feedback
from worldpose.geometry.boxes import are_at_border
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.ingest.clock import remaining_offset
from worldpose.pitch.template import PitchTemplate
from worldpose.review.identities import select_triangulated
from worldpose.static_calibration.venue import Venue, join_cameras
from worldpose.store.store import Store
from worldpose.triangulation.camera_changes import correct_views
from worldpose.triangulation.clocks import move_to_match_time
from worldpose.triangulation.settings import TriangulationSettings

PAGE = 256
"""Frames per read."""
VENUES = 4
"""Venues that a process keeps: reading 16 cameras takes 0.5 s, in most stages twice."""
PAGES = 4
"""Cached pages of a long array: a chunk with its margins fits into four."""
SMALL_BYTES = 2**28 + 2**27
"""Size of an array that stays in memory as a whole once read [bytes]: a minute of 16 cameras needs
a third of it. Stages read a clip up to six times."""


class PagedArray:
    """An array of `shape` (frames, ...) that is read in pages, the last of which stay in memory."""

    def __init__(
        self,
        shape: tuple[int, ...],
        read: Callable[[slice], NDArray[Any]],
        dtype: DTypeLike = np.float64,
        page: int = PAGE,
        pages: int | None = None,
    ) -> None:
        """Open an array of a shape, whose rows `read` returns, as numbers of `dtype`.

        It is read by `page` rows, of which `pages` stay in memory; None = all of a small array.
        """
        self.shape = shape
        self._dtype, self._rows = np.dtype(dtype), page
        is_small = math.prod(shape) * np.dtype(np.float32).itemsize <= SMALL_BYTES
        self._page = lru_cache(pages or (None if is_small else PAGES))(
            lambda number: read(slice(number * page, min((number + 1) * page, shape[0])))
        )
        self._reading = Lock()

    @classmethod
    def of(cls, array: xr.DataArray) -> PagedArray:
        """Open a stored array, read by whole chunks; the last one read stays in memory.

        A page seldom ends where a chunk does: by pages, each chunk would be decoded two or three
        times. Zarr finds numbers at a list of indices one by one, at a microsecond for each.
        """
        chunks = array.encoding.get("chunks")
        length = chunks[0] if chunks else PAGE
        page = length * math.ceil(PAGE / length)
        return cls(array.shape, lambda rows: array[rows].values, array.dtype, page, 1)

    def __getitem__(self, frames: slice | Integers) -> NDArray[Any]:
        """Return some frames."""
        row = np.arange(self.shape[0])[frames]
        out = np.empty((len(row), *self.shape[1:]), self._dtype)
        for number in np.unique(row // self._rows).tolist():
            here = row // self._rows == number
            with self._reading:  # else two threads that need one page would both read it
                page = self._page(number)
            out[here] = page[row[here] - number * self._rows]
        return out


class StoredFeedback:
    """Results of the previous iteration in a store, read by frames.

    Args:
        cameras: detections of each camera, with redetected people.
        filtering: rejected keypoints and shifts of the same frames; None = first iteration.
        without: results that do not apply, of `rejected`, `shift` and `redetected`.
    """

    def __init__(
        self,
        cameras: Sequence[xr.Dataset],
        filtering: xr.Dataset | None = None,
        without: Collection[str] = (),
    ) -> None:
        self._cameras, self._hide = cameras, "redetected" in without
        self._results = {
            name: PagedArray.of(filtering[name])
            for name in ("rejected", "shift")
            if name not in without and filtering is not None
        }

    def apply(self, name: str, values: Singles, rows: slice) -> Singles:
        """Return some frames of an array of detections with the results applied."""
        needed = {"keypoints": ("shift", "rejected"), "confidence": ("rejected",)}.get(name, ())
        found = {each: self._results[each][rows] for each in needed if each in self._results}
        if not found and not self._hide:
            return values
        own = None
        if "shift" in found:
            own = np.zeros(values.shape, np.float32)
            _fill_cameras(own, [each.get("shift") for each in self._cameras], rows)
        marked = mark_redetected(self._cameras, rows)
        feedback = Feedback(marked, found.get("rejected"), found.get("shift"), own, self._hide)
        return apply_feedback(name, values, feedback)


def mark_redetected(cameras: Sequence[xr.Dataset], rows: slice) -> Flags:
    """Return which detections (frames, cameras, detections) of some frames are redetected."""
    most = max(1, *(camera.sizes["detection"] for camera in cameras))
    frames = len(range(*rows.indices(cameras[0].sizes["frame"])))
    found = np.full((frames, len(cameras), most), -1)
    _fill_cameras(found, [each.get("found_again") for each in cameras], rows)
    return np.asarray(found >= 0)


def _fill_cameras(out: NDArray[Any], arrays: Sequence[xr.DataArray | None], rows: slice) -> None:
    """Write some frames of each camera's array to `out` (frames, cameras, detections, ...)."""
    for camera, array in enumerate(arrays):
        if array is not None:
            out[:, camera, : array.shape[1]] = array[rows].values


def open_detections(
    cameras: Sequence[xr.Dataset],
    frame: Integers,
    feedback: StoredFeedback,
    correct: Callable[[str, Singles, slice], Singles] | None = None,
) -> KeypointDetections[ClipArray]:
    """Return the detections of all cameras, read in pages; NaN beyond a camera's number of them.

    `correct` returns the points or boxes of rows as cameras would show them that do not change.
    """
    aligned, points = align_points(cameras)
    most = max(1, *(camera.sizes["detection"] for camera in cameras))

    def open_array(name: str) -> PagedArray:
        stored = [PagedArray.of(camera[name]) for camera in aligned]
        frames, _, *rest = aligned[0][name].shape
        shape = (frames, len(stored), most, *rest)

        def read(rows: slice) -> Singles:
            page = np.full((rows.stop - rows.start, *shape[1:]), np.nan, dtype=np.float32)
            for camera, array in enumerate(stored):
                part = array[rows]
                page[:, camera, : part.shape[1]] = part
            page = feedback.apply(name, page, rows)
            if correct is None or name not in ("keypoints", "extra_keypoints", "boxes"):
                return page
            return correct(name, page, rows)

        return PagedArray(shape, read)

    names = [array.name for array in (*KEYPOINT_ARRAYS, *(EXTRA_ARRAYS if points else ()))]
    arrays: dict[str, Any] = {name: open_array(name) for name in names}
    return KeypointDetections[ClipArray](**arrays, frame=frame, points=points)


@dataclass(frozen=True)
class ClipInputs:
    """Static cameras of a clip and their detections, which are read on access.

    Attributes:
        camera_ids: ids in the order of every camera dimension.
        cameras: (cameras,) batch.
        camera_covariance: (cameras, 12, 12) covariance of the parameters; None unless known for
            all.
        detections: (frames, cameras, detections) detections of all cameras, with match frames.
        fps: frames per second of match time.
        surface: (2,) crown and end fall of the pitch that the cameras show [m]; None = as in
            pitch.json.
        person: (persons,) ids of the tracked people; none before tracking.
    """

    camera_ids: tuple[str, ...]
    cameras: Camera
    camera_covariance: NDArray[np.float64] | None
    detections: KeypointDetections[ClipArray]
    fps: float
    surface: NDArray[np.float64] | None = None
    person: NDArray[np.integer] = field(default_factory=lambda: np.empty(0, dtype=np.int32))

    def raise_pitch(self, pitch: PitchTemplate | None) -> PitchTemplate | None:
        """Return a pitch, if there is one, with the surface that the cameras show."""
        return pitch if pitch is None or self.surface is None else pitch.with_surface(self.surface)


ADJUSTED = "bundle_adjustment/cameras"
"""All static cameras after adjustment to people."""


def open_clip(
    inputs: UnitInputs, without: Collection[str] = (), further: Sequence[CameraChange] = ()
) -> ClipInputs:
    """Open the unit's clip; its detections are read on access.

    `without` names results of the previous iteration that do not apply, as in `StoredFeedback`;
    `further` are changes of cameras within the clip besides those that earlier stages found.
    """
    seen = inputs.sources["seen"]
    return _open_inputs(
        inputs, _open_frames(inputs, inputs.unit, inputs.frames, seen, without, further)
    )


def _open_frames(
    inputs: UnitInputs,
    clip: str,
    frame: Integers,
    names: Sequence[str],
    without: Collection[str] = (),
    further: Sequence[CameraChange] = (),
) -> KeypointDetections[ClipArray]:
    """Open rising match frames of a clip; `names` are each camera's detections."""
    seen = [select_frames(_open_detections(inputs, name), frame) for name in names]
    name = f"filtering/{clip}"
    filtering = select_frames(inputs.open(name), frame) if name in inputs else None
    correct = _view_corrector(inputs, clip, frame, further)
    return open_detections(seen, frame, StoredFeedback(seen, filtering, without), correct)


def _view_corrector(
    inputs: UnitInputs, clip: str, frame: Integers, further: Sequence[CameraChange]
) -> Callable[[str, Singles, slice], Singles] | None:
    """Return the correction of cameras whose view changes; None if all stay as they are.

    Clips may overlap in time: each is corrected by the changes that were found in it, and all by
    `further`. Rows are match frames `frame`.
    """
    views = [each for each in (*known_changes(inputs, clip), *further) if each.kind == "view"]
    if not views:
        return None
    names = tuple(inputs.sources["cameras"])
    cameras, _, _ = _load_cameras(inputs, names)
    known = {name: cameras[c] for c, name in enumerate(names)}

    def correct(name: str, page: Singles, rows: slice) -> Singles:
        points = page.reshape(*page.shape[:3], -1, 2)  # a box has two corners
        moved = correct_views(points, frame[rows], known, views).reshape(page.shape)
        if name == "boxes":
            # A side at the image's border stays there: the border cuts off the person.
            stays = are_at_border(page, cameras.image_size[:, None]) & np.isfinite(moved)
            moved = np.where(stays, page, moved)
            moved[..., 2:] = np.fmax(moved[..., 2:], moved[..., :2])  # of a person gone beyond it
        return moved.astype(page.dtype)

    return correct


def known_changes(inputs: UnitInputs, clip: str) -> list[CameraChange]:
    """Return the changes of cameras within a clip that the stages before this unit found."""
    for name in (f"triangulation/{clip}", f"retriangulation/{clip}", f"tracking/{clip}"):
        if name in inputs:
            return [CameraChange.model_validate(one) for one in inputs.open(name).attrs["changes"]]
    return []


def open_tracked_clip(inputs: UnitInputs, without: Collection[str] = ()) -> ClipInputs:
    """Open the unit's clip with its tracked people that are triangulated; as `open_clip`."""
    clip = open_clip(inputs, without)
    tracks = select_triangulated(inputs.open(f"tracking/{inputs.unit}"))
    people = clip.detections.assign_people(tracks["detection_index"].values)
    return replace(clip, detections=_on_match_clock(inputs, people), person=tracks["person"].values)


def _on_match_clock(
    inputs: UnitInputs, people: KeypointDetections[ClipArray]
) -> KeypointDetections[ClipArray]:
    """Return tracked people of consecutive frames at match time, read on access."""
    if "clocks" not in inputs.sources:
        return people
    clocks = [remaining_offset(people.frame, *clock) for clock in inputs.sources["clocks"]]
    late = np.stack(clocks, axis=1)

    def correct(array: ClipArray) -> PagedArray:
        def read(rows: slice) -> NDArray[np.float64]:
            wide = slice(max(0, rows.start - 1), min(len(late), rows.stop + 1))
            moved = move_to_match_time(array[wide], people.detection_index[wide], late[wide])
            return moved[rows.start - wide.start : rows.stop - wide.start]

        return PagedArray(array.shape, read)

    extra = people.extra_keypoints
    return replace(
        people,
        keypoints=correct(people.keypoints),
        extra_keypoints=None if extra is None else correct(extra),
    )


def camera_rates(inputs: UnitInputs) -> NDArray[np.float64]:
    """Return the frames of each camera's video per match frame, (cameras,)."""
    clocks = inputs.sources.get("clocks") or [[0, 1.0]] * len(inputs.sources["cameras"])
    return np.array([rate for _, rate in clocks])


def triangulation_settings(inputs: UnitInputs, clip: str) -> TriangulationSettings:
    """Return the settings of the first triangulation of a clip, which all clips share."""
    return inputs.made_from(f"triangulation/{clip}").settings(TriangulationSettings)


def select_frames(stored: xr.Dataset, frame: NDArray[np.int64]) -> xr.Dataset:
    """Return some rising match frames of a result, read on access.

    Evenly spaced frames are a slice, which is read faster than a list.
    """
    places = stored.get_index("frame").get_indexer(frame)
    steps = np.unique(np.diff(places))
    if not len(places) or (places < 0).any() or len(steps) > 1:
        return stored.sel(frame=frame)
    step = int(steps[0]) if len(steps) else 1
    return stored.isel(frame=slice(int(places[0]), int(places[-1]) + 1, step))


def load_dropped_boxes(inputs: UnitInputs) -> Flags | None:
    """Return boxes dropped by the previous iteration (frames, cameras, detections), if any."""
    before = f"filtering/{inputs.unit}"
    if before not in inputs:
        return None
    dropped = inputs.open(before)["dropped"]
    frame = dropped["frame"].values
    seen = [select_frames(_open_detections(inputs, n), frame) for n in inputs.sources["seen"]]
    return align_results(dropped.values, mark_redetected(seen, slice(None)))


def open_frames(inputs: UnitInputs, frames: Mapping[str, NDArray[np.int64]]) -> ClipInputs:
    """Open selected match frames of each clip in memory, with tracked people at match time."""
    parts = []
    for clip, frame in frames.items():
        read, names = frame, inputs.sources["seen"][clip]
        if "clocks" in inputs.sources:  # people move between neighbouring frames
            first, count = inputs.sources["clips"][clip]
            read = np.arange(first, first + count)
        found = _open_frames(inputs, clip, read, names)
        if "clocks" in inputs.sources:
            tracks = select_triangulated(inputs.open(f"tracking/{clip}"))
            found = found.assign_people(tracks["detection_index"].values)
            found = _on_match_clock(inputs, found)
        bare = replace(found, points=(), extra_keypoints=None, extra_confidence=None)
        parts.append(bare[np.searchsorted(read, frame)].arrays())
    most = max(part["score"].shape[2] for part in parts)
    arrays: dict[str, Any] = {
        name: np.concatenate([_pad_detections(part[name], most) for part in parts])
        for name in parts[0]
    }
    detections = KeypointDetections(**arrays, frame=np.concatenate(list(frames.values())))
    return _open_inputs(inputs, detections)


def _pad_detections(array: AnyFloats, most: int) -> AnyFloats:
    """Return an array (frames, cameras, detections, ...) with NaN for detections up to `most`."""
    more = [(0, 0), (0, 0), (0, most - array.shape[2]), *[(0, 0)] * (array.ndim - 3)]
    return np.pad(array, more, constant_values=np.nan)


def _open_detections(inputs: UnitInputs, name: str) -> xr.Dataset:
    """Return a camera's detections, with redetected people if they are an input."""
    return inputs.open_first(redetection_name(name) or name, name)


def _open_inputs(inputs: UnitInputs, detections: KeypointDetections[ClipArray]) -> ClipInputs:
    """Return detections with their cameras: the adjusted ones if these are an input."""
    camera_ids = tuple(inputs.sources["cameras"])
    cameras, covariance, surface = _load_cameras(inputs, camera_ids)
    fps = float(inputs.sources["fps"])
    return ClipInputs(camera_ids, cameras, covariance, detections, fps, surface)


def align_points(seen: Sequence[xr.Dataset]) -> tuple[list[xr.Dataset], tuple[str, ...]]:
    """Return the detections of all cameras with the same points besides COCO-17, and their names.

    A camera without a point that another has gets NaN.
    """
    given = [
        tuple(clip["point"].values.tolist()) if EXTRA_ARRAYS[0].name in clip else ()
        for clip in seen
    ]
    points = tuple(dict.fromkeys(point for each in given for point in each))
    aligned = []
    for clip, own in zip(seen, given, strict=True):
        if own == points:
            aligned.append(clip)
            continue
        empty = np.broadcast_to(
            np.float32(np.nan), (clip.sizes["frame"], clip.sizes["detection"], len(points), 2)
        )
        filled = {
            array.name: (array.dims, empty[..., 0] if array.dims[-1] == "point" else empty)
            for array in EXTRA_ARRAYS
        }
        whole = clip.reindex(point=list(points)) if own else clip.assign(filled)
        aligned.append(whole.assign_coords(point=list(points)))
    return aligned, points


def open_venue(inputs: UnitInputs, camera_ids: Sequence[str]) -> Venue:
    """Return calibrated or given static cameras on the pitch that they show together."""
    recipe = inputs.recipe
    keys = tuple((camera, recipe.inputs[f"static_calibration/{camera}"]) for camera in camera_ids)
    return _join_calibrated(inputs.work.project, recipe.match_id, keys)


@lru_cache(VENUES)
def _join_calibrated(project: str, match_id: str, keys: tuple[tuple[str, str], ...]) -> Venue:
    """Return cameras by the keys of their calibration; a key names one content."""
    store = Store.open(project)
    each = [store.open_result(match_id, "static_calibration", camera, key) for camera, key in keys]
    return join_cameras([camera.data_vars for camera in each])


def _load_cameras(
    inputs: UnitInputs, camera_ids: tuple[str, ...]
) -> tuple[Camera, NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Return the cameras in order, their covariances if known for all, and the pitch's surface."""
    if ADJUSTED in inputs:
        adjusted = inputs.open(ADJUSTED)
        stated = adjusted["camera_covariance"].values
        known = bool(stated.any(axis=(1, 2)).all())  # an unchanged given camera has none
        surface = adjusted.attrs["surface"]
        return (
            camera_from_arrays(adjusted.data_vars),
            stated if known else None,
            None if surface is None else np.array(surface),
        )
    venue = open_venue(inputs, camera_ids)
    known = bool(np.isfinite(venue.covariance).all())  # a given camera has no covariance
    shape = None if venue.surface is None else venue.surface.shape
    return venue.cameras, venue.covariance if known else None, shape
