"""Frames of a match as all static cameras see them, on one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.work import Work
from tasks.unit import open_input
from worldpose.cameras import Camera
from worldpose.cameras.stored import camera_from_arrays
from worldpose.store import Store
from worldpose.tracking.clip_arrays import ClipArray

PAGE = 256
"""Frames read at a time."""
PAGES = 4
"""Pages kept: a stretch with its margins lies in four."""


class StoredClip:
    """One array of every camera's detections, padded to the same number, read when it is used.

    Rejected keypoints are as if they had not been found.

    Attributes:
        shape: (frames, cameras, detections, ...).
    """

    def __init__(
        self,
        clips: Sequence[xr.Dataset],
        name: str,
        rejected: xr.DataArray | None = None,
        shift: xr.DataArray | None = None,
    ) -> None:
        arrays = [clip[name] for clip in clips]
        detections = max(1, *(array.sizes["detection"] for array in arrays))
        frames, _, *rest = arrays[0].shape
        self.shape: tuple[int, ...] = (frames, len(arrays), detections, *rest)
        self._arrays = arrays
        self._rejected = rejected
        self._shift = shift
        self._page = lru_cache(PAGES)(self._read)

    def __getitem__(self, frames: slice) -> NDArray[np.float64]:
        """A stretch of frames as float64; NaN where a camera has fewer detections."""
        first, last, _ = frames.indices(self.shape[0])
        out = np.empty((max(0, last - first), *self.shape[1:]))
        for number in range(first // PAGE, -(-last // PAGE)):
            start, stop = max(first, number * PAGE), min(last, (number + 1) * PAGE)
            page = self._page(number)
            out[start - first : stop - first] = page[start - number * PAGE : stop - number * PAGE]
        return out

    def _read(self, number: int) -> NDArray[np.float32]:
        start, stop = number * PAGE, min((number + 1) * PAGE, self.shape[0])
        page = np.full((stop - start, *self.shape[1:]), np.nan, dtype=np.float32)
        for camera, array in enumerate(self._arrays):
            page[:, camera, : array.sizes["detection"]] = array[start:stop].values
        if self._shift is not None:
            page -= self._shift[start:stop].values
        if self._rejected is not None:
            page[self._rejected[start:stop].values] = np.nan
        return page


@dataclass(frozen=True)
class ClipInputs:
    """Observations of some frames.

    Attributes:
        camera_ids: in the order of every camera dimension.
        cameras: (cameras,) batch.
        camera_covariance: (cameras, 12, 12) of a step of each; None where not all are known.
        frame: (frames,) match frames.
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17); NaN where not found.
        fps: frames a second of match time.
    """

    camera_ids: tuple[str, ...]
    cameras: Camera
    camera_covariance: NDArray[np.float64] | None
    frame: NDArray[np.int64]
    keypoints: ClipArray
    confidence: ClipArray
    fps: float


ADJUSTED = "bundle_adjustment/cameras"
"""All static cameras, where they are adjusted to people."""


def open_clip(
    store: Store, work: Work, *, filtered: bool = True, shifted: bool = True
) -> ClipInputs:
    """The clip of `work`; its detections are read when they are used.

    Args:
        store: the store.
        work: the work under way.
        filtered: without what the bodies of the iteration before contradicted.
        shifted: without what keypoints were beside those bodies by for lasting reasons.
    """
    first, count = work.recipe.sources["first_frame"], work.recipe.sources["frame_count"]
    where = slice(first, first + count - 1)
    seen = [open_input(store, work, name).sel(frame=where) for name in work.recipe.sources["seen"]]
    said = _said_before(store, work, {work.recipe.unit: where})
    rejected, shift = said["rejected"] if filtered else None, said["shift"] if shifted else None
    return _open(store, work, np.arange(first, first + count), seen, rejected, shift)


def open_frames(store: Store, work: Work, frames: Mapping[str, NDArray[np.int64]]) -> ClipInputs:
    """Match frames of each clip, clip by clip, with every camera's detections in memory."""
    names = work.recipe.sources["seen"]
    seen = [
        _together(
            [open_input(store, work, names[clip][c]).sel(frame=frames[clip]) for clip in frames]
        )
        for c in range(len(work.recipe.sources["cameras"]))
    ]
    frame = np.concatenate(list(frames.values()))
    some = _open(store, work, frame, seen, **_said_before(store, work, frames))
    keypoints, confidence = some.keypoints[: len(frame)], some.confidence[: len(frame)]
    return replace(some, keypoints=keypoints, confidence=confidence)


def _together(clips: Sequence[xr.Dataset]) -> xr.Dataset:
    """Whom one camera saw, clip by clip, padded to the same number."""
    most = max(clip.sizes["detection"] for clip in clips)
    padded = [
        clip[["keypoints", "confidence"]].pad(detection=(0, most - clip.sizes["detection"]))
        for clip in clips
    ]
    return xr.concat(padded, dim="frame")


def _said_before(
    store: Store, work: Work, frames: Mapping[str, NDArray[np.int64] | slice]
) -> dict[str, xr.DataArray | None]:
    """What the iteration before said of keypoints, frame by frame; None in the first."""
    clips = [
        open_input(store, work, name)[["rejected", "shift"]].sel(frame=where)
        for clip, where in frames.items()
        if (name := f"filtering/{clip}") in work.recipe.inputs
    ]
    if not clips:
        return {"rejected": None, "shift": None}
    together = clips[0]
    if len(clips) > 1:
        most = max(clip.sizes["detection"] for clip in clips)
        nothing = {"rejected": False, "shift": 0.0}
        padded = [
            clip.pad(detection=(0, most - clip.sizes["detection"]), constant_values=nothing)
            for clip in clips
        ]
        together = xr.concat(padded, dim="frame")
    return {"rejected": together["rejected"], "shift": together["shift"]}


def _open(
    store: Store,
    work: Work,
    frame: NDArray[np.int64],
    seen: Sequence[xr.Dataset],
    rejected: xr.DataArray | None,
    shift: xr.DataArray | None,
) -> ClipInputs:
    """Match frames, with whom each camera saw in them.

    The cameras are the adjusted ones where `work` is made from them.
    """
    sources = work.recipe.sources
    camera_ids = tuple(sources["cameras"])
    cameras, covariance = _cameras(store, work, camera_ids)
    return ClipInputs(
        camera_ids=camera_ids,
        cameras=cameras,
        camera_covariance=covariance,
        frame=frame,
        keypoints=StoredClip(seen, "keypoints", rejected, shift),
        confidence=StoredClip(seen, "confidence", rejected),
        fps=float(sources["fps"]),
    )


def _cameras(
    store: Store, work: Work, camera_ids: tuple[str, ...]
) -> tuple[Camera, NDArray[np.float64] | None]:
    """The cameras in order, and how well they are known, where all of them tell."""
    if ADJUSTED in work.recipe.inputs:
        adjusted = open_input(store, work, ADJUSTED)
        return camera_from_arrays(adjusted.data_vars), adjusted["camera_covariance"].values
    each = [open_input(store, work, f"static_calibration/{camera}") for camera in camera_ids]
    cameras = Camera.stack([camera_from_arrays(camera.data_vars) for camera in each])
    if all("covariance" in camera for camera in each):
        return cameras, np.stack([camera["covariance"].values for camera in each])
    return cameras, None  # a given camera tells none
