"""Synchronized frames of a match with the detections of all static cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Integers
from data_contracts.detection import redetection_name
from data_contracts.keypoints import EXTRA_ARRAYS, KeypointDetections
from tasks.unit import UnitInputs
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.venue import Venue, join_cameras
from worldpose.store.store import Store

PAGE = 256
"""Frames per read."""
VENUES = 4
"""Venues that a process keeps: reading 16 cameras takes 0.5 s, in most stages twice."""
PAGES = 4
"""Cached pages of a long array: a chunk with its margins fits into four."""
SMALL_BYTES = 2**28 + 2**27
"""Size of an array that stays in memory as a whole once read [bytes]: a minute of 16 cameras needs
a third of it. Stages read a clip up to six times."""


class ChunkedRows:
    """Rows of a stored array, read by whole chunks; the last one read stays in memory.

    A page seldom ends where a chunk does: by pages, each chunk would be decoded two or three times.
    """

    def __init__(self, array: xr.DataArray) -> None:
        chunks = array.encoding.get("chunks")
        length = chunks[0] if chunks else PAGE
        self._array = array
        self._length = length * math.ceil(PAGE / length)
        self._last: tuple[int, NDArray[Any]] = (-1, np.empty(0))

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Return the rows from a start to a stop."""
        length = self._length
        parts = []
        for number in range(rows.start // length, (rows.stop - 1) // length + 1):
            held, values = self._last  # read at once: threads may replace it
            first = number * length
            if held != number:
                values = self._array[first : first + length].values
                self._last = (number, values)
            parts.append(values[max(rows.start - first, 0) : rows.stop - first])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)


def read_rows(array: xr.DataArray, rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return some rising rows of a stored array, one read for each run of consecutive ones.

    Zarr finds numbers at a list of indices one by one, which takes a microsecond and a hundred
    bytes for each.
    """
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1) if len(rows) else [rows]
    parts = [
        array[int(run[0]) : int(run[-1]) + 1].values if len(run) else array[:0].values
        for run in runs
    ]
    return np.concatenate(parts)


class StoredArray:
    """One array of all cameras' detections in a store, padded to the same number, read in pages.

    Rejected keypoints count as not detected. Filtering results of a detection index do not apply to
    people redetected at that index since.

    Attributes:
        shape: (frames, cameras, detections, ...).
    """

    def __init__(
        self,
        clips: Sequence[xr.Dataset],
        name: str,
        rejected: xr.DataArray | None = None,
        shift: xr.DataArray | None = None,
        *,
        redetected: bool = True,
    ) -> None:
        """Open the arrays.

        Args:
            clips: detections of each camera.
            name: name of the array.
            rejected: (frames, cameras, detections, 17), keypoints to leave out.
            shift: (frames, cameras, detections, 17, 2) [px], systematic error to subtract.
            redetected: include redetected people.
        """
        arrays = [clip[name] for clip in clips]
        detections = max(1, *(array.sizes["detection"] for array in arrays))
        frames, _, *rest = arrays[0].shape
        self.shape: tuple[int, ...] = (frames, len(arrays), detections, *rest)
        self._arrays = [ChunkedRows(array) for array in arrays]
        self._clips = clips
        self._redetected = redetected
        self._rejected = None if rejected is None else ChunkedRows(rejected)
        self._shift = None if shift is None else ChunkedRows(shift)
        is_small = math.prod(self.shape) * np.dtype(np.float32).itemsize <= SMALL_BYTES
        self._page = lru_cache(None if is_small else PAGES)(self._read)
        self._reading = Lock()

    def __getitem__(self, frames: slice | Integers) -> NDArray[np.float64]:
        """Return some frames as float64; NaN beyond a camera's number of detections."""
        row = np.arange(self.shape[0])[frames]
        out = np.empty((len(row), *self.shape[1:]))
        for number in np.unique(row // PAGE).tolist():
            here = row // PAGE == number
            with self._reading:  # else two threads that need one page would both read it
                page = self._page(number)
            out[here] = page[row[here] - number * PAGE]
        return out

    def _read(self, number: int) -> NDArray[np.float32]:
        start, stop = number * PAGE, min((number + 1) * PAGE, self.shape[0])
        page = np.full((stop - start, *self.shape[1:]), np.nan, dtype=np.float32)
        rows = slice(start, stop)
        for camera, array in enumerate(self._arrays):
            part = array[rows]
            page[:, camera, : part.shape[1]] = part
        if self._shift is not None:
            page -= _align_results(self._clips, self._shift[rows], page.shape, rows)
            for camera, clip in enumerate(self._clips):
                if "shift" in clip:
                    page[:, camera, : clip.sizes["detection"]] -= clip["shift"][rows].values
        if self._rejected is not None:
            rejected = _align_results(self._clips, self._rejected[rows], page.shape[:4], rows)
            page[rejected] = np.nan
        if not self._redetected:
            page[_mark_redetected(self._clips, page.shape[:3], rows)] = np.nan
        return page


def _align_results(
    clips: Sequence[xr.Dataset], before: NDArray[Any], shape: tuple[int, ...], rows: slice
) -> NDArray[Any]:
    """Return filtering results of the previous iteration for current detections; zero for new ones.

    Args:
        clips: detections of each camera.
        before: (rows, cameras, previous detections, ...), results in these frames.
        shape: (rows, cameras, detections, ...) shape of the result.
        rows: slice of the frames.
    """
    out = np.zeros(shape, dtype=before.dtype)
    both = min(shape[2], before.shape[2])
    out[:, :, :both] = before[:, :, :both]
    out[_mark_redetected(clips, shape[:3], rows)] = 0
    return out


def _mark_redetected(
    clips: Sequence[xr.Dataset], shape: tuple[int, ...], rows: slice
) -> NDArray[np.bool_]:
    """Return a mask (rows, cameras, detections) of redetected people."""
    found = np.zeros(shape, dtype=np.bool_)
    for camera, clip in enumerate(clips):
        if "found_again" in clip:
            found[:, camera, : clip.sizes["detection"]] = clip["found_again"][rows].values >= 0
    return found


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
    """

    camera_ids: tuple[str, ...]
    cameras: Camera
    camera_covariance: NDArray[np.float64] | None
    detections: KeypointDetections[ClipArray]
    fps: float
    surface: NDArray[np.float64] | None = None

    def raise_pitch(self, pitch: PitchTemplate | None) -> PitchTemplate | None:
        """Return a pitch, if there is one, with the surface that the cameras show."""
        return pitch if pitch is None or self.surface is None else pitch.with_surface(self.surface)

    def assign_people(self, detection_index: NDArray[np.integer]) -> ClipInputs:
        """Return the clip with tracked people (frames, cameras, persons)."""
        return replace(self, detections=self.detections.assign_people(detection_index))


NOTHING = {
    **dict.fromkeys(("keypoints", "confidence", "boxes", "score"), np.nan),
    "found_again": -1,
    "shift": 0.0,
}
"""Fill values of padded detections."""
ADJUSTED = "bundle_adjustment/cameras"
"""All static cameras after adjustment to people."""


def open_clip(
    inputs: UnitInputs,
    *,
    filtered: bool = True,
    shifted: bool = True,
    redetected: bool = True,
) -> ClipInputs:
    """Open the unit's clip; its detections are read on access.

    Args:
        inputs: the unit.
        filtered: leave out keypoints that the previous iteration rejected.
        shifted: subtract the systematic errors of keypoints.
        redetected: include redetected people.
    """
    frame = inputs.frames
    where = slice(int(frame[0]), int(frame[-1]))
    seen = _open_cameras(inputs, where)
    rejected, shift = _load_filtering_results(inputs, {inputs.unit: where})
    return _make_inputs(
        inputs,
        frame,
        seen,
        rejected if filtered else None,
        shift if shifted else None,
        redetected=redetected,
    )


def select_frames(stored: xr.Dataset, frame: NDArray[np.int64]) -> xr.Dataset:
    """Return some rising match frames of a result, read on access.

    Evenly spaced frames are a slice, which is read faster than a list (`read_rows`).
    """
    places = stored.get_index("frame").get_indexer(frame)
    steps = np.unique(np.diff(places))
    if not len(places) or (places < 0).any() or len(steps) > 1:
        return stored.sel(frame=frame)
    step = int(steps[0]) if len(steps) else 1
    return stored.isel(frame=slice(int(places[0]), int(places[-1]) + 1, step))


def load_dropped_boxes(inputs: UnitInputs) -> NDArray[np.bool_] | None:
    """Return boxes dropped by the previous iteration (frames, cameras, detections), if any."""
    before = f"filtering/{inputs.unit}"
    if before not in inputs:
        return None
    dropped = inputs.open(before)["dropped"]
    frame = dropped["frame"].values
    seen = _open_cameras(inputs, slice(frame[0], frame[-1]))
    detections = max(1, *(clip.sizes["detection"] for clip in seen))
    return _align_results(seen, dropped.values, (*dropped.shape[:2], detections), slice(None))


def open_frames(inputs: UnitInputs, frames: Mapping[str, NDArray[np.int64]]) -> ClipInputs:
    """Open selected match frames of each clip, with every camera's detections in memory."""
    names = inputs.sources["seen"]
    seen = [
        _concatenate_clips(
            [
                select_frames(_open_detections(inputs, names[clip][c]), frames[clip])
                for clip in frames
            ]
        )
        for c in range(len(inputs.sources["cameras"]))
    ]
    frame = np.concatenate(list(frames.values()))
    some = _make_inputs(inputs, frame, seen, *_load_filtering_results(inputs, frames))
    return replace(some, detections=some.detections[: len(frame)])


def _open_cameras(inputs: UnitInputs, where: slice) -> list[xr.Dataset]:
    """Return each camera's detections in the unit's clip."""
    return [_open_detections(inputs, name).sel(frame=where) for name in inputs.sources["seen"]]


def _open_detections(inputs: UnitInputs, name: str) -> xr.Dataset:
    """Return a camera's detections, with redetected people if they are an input."""
    return inputs.open_first(redetection_name(name) or name, name)


def _concatenate_clips(clips: Sequence[xr.Dataset]) -> xr.Dataset:
    """Concatenate one camera's detections over clips, padded to the same number."""
    most = max(clip.sizes["detection"] for clip in clips)
    padded = []
    for clip in clips:
        names = [each for each in NOTHING if each in clip]
        more = (0, most - clip.sizes["detection"])
        padded.append(clip[names].pad(detection=more, constant_values=NOTHING))
    return xr.concat(padded, dim="frame")


def _load_filtering_results(
    inputs: UnitInputs, frames: Mapping[str, NDArray[np.int64] | slice]
) -> tuple[xr.DataArray | None, xr.DataArray | None]:
    """Return rejections and shifts by the previous iteration by frame; None in the first one."""
    clips = [
        inputs.open(name)[["rejected", "shift"]].sel(frame=where)
        for clip, where in frames.items()
        if (name := f"filtering/{clip}") in inputs
    ]
    if not clips:
        return None, None
    merged = clips[0]
    if len(clips) > 1:
        most = max(clip.sizes["detection"] for clip in clips)
        nothing = {"rejected": False, "shift": 0.0}
        padded = [
            clip.pad(detection=(0, most - clip.sizes["detection"]), constant_values=nothing)
            for clip in clips
        ]
        merged = xr.concat(padded, dim="frame")
    return merged["rejected"], merged["shift"]


def _make_inputs(
    inputs: UnitInputs,
    frame: NDArray[np.int64],
    seen: Sequence[xr.Dataset],
    rejected: xr.DataArray | None,
    shift: xr.DataArray | None,
    *,
    redetected: bool = True,
) -> ClipInputs:
    """Open match frames with each camera's detections.

    The cameras are the adjusted ones if these are an input.
    """
    camera_ids = tuple(inputs.sources["cameras"])
    cameras, covariance, surface = _load_cameras(inputs, camera_ids)
    seen, points = _align_points(seen)
    extra = [
        StoredArray(seen, array.name, redetected=redetected) if points else None
        for array in EXTRA_ARRAYS
    ]
    return ClipInputs(
        camera_ids=camera_ids,
        cameras=cameras,
        camera_covariance=covariance,
        detections=KeypointDetections[ClipArray](
            keypoints=StoredArray(seen, "keypoints", rejected, shift, redetected=redetected),
            confidence=StoredArray(seen, "confidence", rejected, redetected=redetected),
            boxes=StoredArray(seen, "boxes", redetected=redetected),
            score=StoredArray(seen, "score", redetected=redetected),
            frame=frame,
            points=points,
            extra_keypoints=extra[0],
            extra_confidence=extra[1],
        ),
        surface=surface,
        fps=float(inputs.sources["fps"]),
    )


def _align_points(seen: Sequence[xr.Dataset]) -> tuple[list[xr.Dataset], tuple[str, ...]]:
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
