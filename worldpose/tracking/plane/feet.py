"""Places of people on the pitch plane, from their feet in one image.

The ray of an ankle meets the surface at the ankle's height. The error is long along the line of
sight, and short across.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.boxes import are_at_border
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.ground_error import surface_motion

ANKLE_HEIGHT: Final = 0.09
"""Height of an ankle of a standing adult [m]."""
MIN_CONFIDENCE: Final = 0.2
"""Least confidence of an ankle that is used [1]."""
PART_OVERLAP: Final = 0.3
"""Share of the smaller box from which two boxes may be of one person [1]. Second boxes of a person
on the real pair: 0.3 to 1.0; people apart: 0."""
PIXEL_STD: Final = 1.0
"""Standard deviation of a keypoint [px], in addition to `PIXEL_SHARE`."""
PIXEL_SHARE: Final = 0.02
"""The same per height of the person in the image [1]."""


class FrameBlocks:
    """An array (frames, cameras, detections, ...) of parts with their own number of detections.

    In one frame, hundreds of detections may lack what few lack in others.

    Attributes:
        parts: frames of each part, `length` of them but in the last.
        shape: shape of the array with the largest number of detections.
    """

    def __init__(self, parts: Sequence[NDArray[Any]], length: int) -> None:
        self.parts = tuple(parts)
        self._length = length
        first = self.parts[0].shape
        most = max(part.shape[2] for part in self.parts)
        self.shape = (sum(map(len, self.parts)), first[1], most, *first[3:])

    def __getitem__(self, at: tuple[Any, ...]) -> NDArray[Any]:
        """Return values of one frame, the first index; or of several as in `whole`."""
        frame, *rest = at
        if isinstance(frame, slice):
            some: NDArray[Any] = self.whole(frame)[(slice(None), *rest)]
            return some
        part, row = divmod(int(frame), self._length)
        values: NDArray[Any] = self.parts[part][(row, *rest)]
        return values

    def apply(self, function: Callable[[NDArray[Any]], NDArray[Any]]) -> FrameBlocks:
        """Return the array of the function's results for each part."""
        return FrameBlocks([function(part) for part in self.parts], self._length)

    def whole(self, frames: slice = slice(None)) -> NDArray[Any]:
        """Return frames in one piece, whose missing detections are NaN, -1 or False."""
        dtype, rows = self.parts[0].dtype, np.arange(self.shape[0])[frames]
        missing = {"b": False, "i": -1}.get(dtype.kind, np.nan)
        whole = np.full((len(rows), *self.shape[1:]), missing, dtype=dtype)
        for number in np.unique(rows // self._length).tolist():
            part, here = self.parts[number], rows // self._length == number
            whole[here, :, : part.shape[2]] = part[rows[here] - number * self._length]
        return whole


@dataclass(frozen=True, eq=False)
class GroundPositions:
    """Places on the pitch of detected people.

    Attributes:
        xy: (frames, cameras, detections, 2) [m], world; NaN where the feet are not seen.
        noise: (frames, cameras, detections, 2, 2) [m^2], of each detection on its own.
        calibration: (frames, cameras, detections, 2, 2) [m^2], error by the camera's calibration,
            which all detections of a camera nearby share.
        height: (frames, cameras, detections) [m], of the person over the ground, by the upper edge
            of the box; NaN where not known.
        is_whole: (frames, cameras, detections), False for a part of a person: cut by the image
            border, or overlapping a surer detection. None = all are whole.
        boxes: (frames, cameras, detections, 4) [px]; None = not known.
        shirts: (frames, cameras, detections, 3) colours of upper bodies [CIELAB]; NaN where hidden,
            None = not known.
    """

    xy: Floats | FrameBlocks
    noise: Floats | FrameBlocks
    calibration: Floats | FrameBlocks
    height: Floats | FrameBlocks
    is_whole: Flags | FrameBlocks | None = None
    boxes: Floats | FrameBlocks | None = None
    shirts: Floats | FrameBlocks | None = None

    @classmethod
    def concatenate(cls, parts: Sequence[GroundPositions]) -> GroundPositions:
        """Return the frames of several parts with the same number of detections."""
        names = set.intersection(*({*part.arrays()} for part in parts))
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})

    def arrays(self) -> dict[str, Any]:
        """Return the arrays by name, without those that are not known."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: array for name, array in arrays.items() if array is not None}

    @classmethod
    def join(cls, parts: Sequence[GroundPositions], length: int) -> GroundPositions:
        """Return the frames of parts of `length` frames, each with its own number of detections."""
        names = set.intersection(*({*part.arrays()} for part in parts))
        return cls(
            **{name: FrameBlocks([getattr(p, name) for p in parts], length) for name in names}
        )

    def select(self, detections: Integers) -> GroundPositions:
        """Return some detections of every frame and camera (frames, cameras, places), by index."""
        rows, cameras = np.ogrid[: len(detections), : detections.shape[1]]
        at = rows[..., None], cameras[..., None], detections
        return GroundPositions(**{name: array[at] for name, array in self.arrays().items()})

    def number_seen(self) -> NDArray[np.int64]:
        """Return how many detections have a place (frames, cameras)."""
        parts = self.xy.parts if isinstance(self.xy, FrameBlocks) else (self.xy,)
        return np.concatenate(
            [np.isfinite(part[..., 0]).sum(axis=2, dtype=np.int64) for part in parts]
        )


def locate_feet(
    cameras: Camera,
    detections: KeypointDetections,
    pitch: PitchTemplate,
    *,
    camera_covariance: Floats | None = None,
    chosen: Flags | None = None,
) -> GroundPositions:
    """Return where detected people stand on the pitch.

    By the ankles, the place across the line of sight is their middle, and along it halfway from
    there to the nearer foot: a lifted foot seems farther away. The middle of the box's lower edge
    gives a second place; the result is the mean of both, or the one that is known.

    Detections are (frames, cameras, detections); the `chosen` ones, of the same shape, are located,
    the others are NaN; None = all. The covariance of the calibration is (cameras, 12, 12); None =
    exact.
    """
    keypoints, confidence, boxes = detections.keypoints, detections.confidence, detections.boxes
    shape = detections.score.shape
    xy = np.full((*shape, 2), np.nan)
    noise = np.full((*shape, 2, 2), np.nan)
    calibration = np.zeros((*shape, 2, 2))
    height = np.full(shape, np.nan)
    is_whole = np.zeros(shape, dtype=np.bool_)
    ankles = (15, 16)
    # Standard deviation of an ankle's height [m], feet lifted and strides in depth included: 0.05
    # and 0.05 in simulated matches of two kinds.
    foot_height_std = 0.06
    box_share = 0.5  # Share of the box in the place where both ankles and box tell it [1].
    for c in range(shape[1]):
        camera = cameras[c]
        here = np.ones(shape[::2], dtype=np.bool_) if chosen is None else chosen[:, c]
        points = np.asarray(keypoints[:, c][here], dtype=np.float64)  # (people, 17, 2)
        box = np.asarray(boxes[:, c][here], dtype=np.float64)
        feet = np.moveaxis(points[:, ankles, :], 1, 0).copy()  # (2, people, 2)
        feet[(confidence[:, c][here][:, ankles] < MIN_CONFIDENCE).T] = np.nan
        places = np.stack([_meet(camera, foot, pitch, ANKLE_HEIGHT) for foot in feet])
        found = np.isfinite(places[..., 0])
        center = camera.center[:2]
        distance = np.linalg.norm(places - center, axis=-1)
        with np.errstate(invalid="ignore"):
            nearer = np.where((distance[0] <= distance[1])[..., None], places[0], places[1])
        both = found.all(axis=0)
        place = np.where(found[0][..., None], places[0], places[1])
        place[both] = (0.5 * (places[0] + places[1]))[both]
        sight = place - center
        with np.errstate(invalid="ignore"):
            sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        along = ((nearer - place) * sight).sum(axis=-1)
        place[both] += (0.5 * along[..., None] * sight)[both]
        height_std = np.where(both, foot_height_std, 1.5 * foot_height_std)
        bottom = np.stack([0.5 * (box[..., 0] + box[..., 2]), box[..., 3]], axis=-1)
        # A person who is cut by the image's border has no known middle or feet; the top is free.
        sides = are_at_border(box, camera.image_size)
        inside = np.asarray(~sides[..., [0, 2, 3]].any(axis=-1))
        half = 0.5 * np.array([pitch.length, pitch.width])
        on_pitch = (np.abs(place) <= half).all(axis=-1)
        is_part = _are_parts(boxes[:, c], keypoints[:, c], confidence[:, c], here, on_pitch)
        is_whole[:, c][here] = (inside | np.isnan(box[..., 0])) & ~is_part
        # A box's lower edge lies at the toes of the nearer foot: its ray passes below the middle.
        lower = np.where(inside[..., None], _meet(camera, bottom, pitch, -0.06), np.nan)
        absent = ~np.isfinite(place[..., 0])
        place[absent] = lower[absent]
        # Of the lower edge of a box, with its bias.
        height_std = np.where(absent, 0.12, height_std)
        known = ~absent & np.isfinite(lower[..., 0])
        place[known] = ((1.0 - box_share) * place + box_share * lower)[known]
        top = np.stack([bottom[..., 0], box[..., 1]], axis=-1)
        height[:, c][here] = _height_above(camera, top, place, pitch)
        xy[:, c][here] = place
        noise[:, c][here] = _foot_noise(camera, place, height_std, _image_heights(points, box))
        if camera_covariance is not None:
            known = np.isfinite(place[..., 0])
            flat = place[known]
            on_ground = np.column_stack([flat, pitch.height(flat[:, 0], flat[:, 1])])
            motion = surface_motion(camera, pitch, on_ground)
            lasting = np.zeros((len(place), 2, 2))
            lasting[known] = motion @ camera_covariance[c] @ motion.swapaxes(1, 2)
            calibration[:, c][here] = lasting
    xy[~np.isfinite(noise).all(axis=(-1, -2))] = np.nan
    xy[~np.isfinite(calibration).all(axis=(-1, -2))] = np.nan
    kept = np.asarray(boxes, dtype=np.float64)
    return GroundPositions(xy, noise, calibration, height, is_whole, kept)


def _are_parts(
    boxes: AnyFloats, keypoints: AnyFloats, confidence: AnyFloats, chosen: Flags, on_pitch: Flags
) -> Flags:
    """Return which chosen boxes a surer detection of their frame explains.

    Detectors give a person's upper body, or the legs, a box of their own beside the whole one. Its
    joints are those of the whole one; the joints of a person who is partly hidden are not.
    """
    frame, detection = np.nonzero(chosen)
    all_boxes = np.asarray(boxes, dtype=np.float64)
    others, own = all_boxes[frame], all_boxes[frame, detection][:, None]
    total = np.nansum(confidence, axis=-1)
    low, high = np.maximum(own[..., :2], others[..., :2]), np.minimum(own[..., 2:], others[..., 2:])
    area = (all_boxes[..., 2:] - all_boxes[..., :2]).prod(axis=-1)
    with np.errstate(invalid="ignore"):
        common = np.clip(high - low, 0.0, None).prod(axis=-1)
        smaller = np.minimum(area[frame, detection][:, None], area[frame])
        overlap = common >= PART_OVERLAP * smaller
    surer = total[frame] > total[frame, detection][:, None]
    row, other = np.nonzero(overlap & surer)
    first, second = (frame[row], detection[row]), (frame[row], other)
    known = (confidence[first] >= MIN_CONFIDENCE) & (confidence[second] >= MIN_CONFIDENCE)
    apart = np.where(known, np.linalg.norm(keypoints[first] - keypoints[second], axis=-1), np.inf)
    apart[~on_pitch[row]] = 0.0
    height = all_boxes[second][:, 3] - all_boxes[second][:, 1]
    # At least half of the joints that both know; without a common one, the boxes alone decide.
    # In simulation their distance is below 0.02 heights for one person and above 0.12 for two.
    near = (apart < 0.08 * height[:, None]).sum(axis=1)
    is_part = np.zeros(len(frame), dtype=np.bool_)
    is_part[row[2 * near >= known.sum(axis=1)]] = True
    return is_part


def count_covering_cameras(
    cameras: Camera, positions: GroundPositions
) -> NDArray[np.int64] | FrameBlocks:
    """Return how many cameras should see the person of each detection, the own one included.

    Places are (frames, cameras, detections). A camera should if the whole person is in its image,
    and not much smaller than in the camera that has the detection. Other people may stand in
    between.
    """
    if isinstance(positions.xy, FrameBlocks):
        return positions.xy.apply(lambda part: _count_covering(cameras, part))
    return _count_covering(cameras, positions.xy)


def _count_covering(cameras: Camera, places: Floats) -> NDArray[np.int64]:
    """Return the cameras that should see people at places (frames, cameras, detections, 2) [m]."""
    found = np.nonzero(np.isfinite(places[..., 0]))
    xy = places[found]
    # Height of a person that a camera should see [m].
    ends = np.stack([np.insert(xy, 2, z, axis=1) for z in (0.0, 1.7)])
    pixels = cameras[:, None].project(ends)  # (cameras, ends, detections, 2)
    size = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=-1)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0.0) & (pixels <= cameras.image_size[:, None, None] - 1.0)
        # Relative to the camera that does see the person.
        large = size >= 0.6 * size[found[1], np.arange(len(xy))]
    count = np.zeros(places.shape[:3], dtype=np.int64)
    count[found] = np.maximum(1, np.count_nonzero(inside.all(axis=(1, -1)) & large, axis=0))
    return count


def _height_above(camera: Camera, pixels: Floats, place: Floats, pitch: PitchTemplate) -> Floats:
    """Return the height (...) [m] over the ground of pixels at the distance of `place`."""
    rays = camera.unproject(pixels.reshape(-1, 2))
    flat = place.reshape(-1, 2)
    distance = np.linalg.norm(flat - rays.origins[:, :2], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = distance / np.linalg.norm(rays.directions[:, :2], axis=1)
    height = rays.origins[:, 2] + along * rays.directions[:, 2]
    return np.asarray(height - pitch.height(flat[:, 0], flat[:, 1])).reshape(pixels.shape[:-1])


def _meet(camera: Camera, pixels: Floats, pitch: PitchTemplate, above: float) -> Floats:
    """Return where rays meet the surface raised by `above` [m] (..., 2); NaN above the horizon."""
    rays = camera.unproject(pixels.reshape(-1, 2))
    height = np.full(len(rays.origins), above)
    place = np.full((len(rays.origins), 2), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(3):  # the crown is flat: the second step changes millimetres
            along = (height - rays.origins[:, 2]) / rays.directions[:, 2]
            place = rays.origins[:, :2] + along[:, None] * rays.directions[:, :2]
            place[~(along > 0.0)] = np.nan
            height = above + pitch.height(
                np.clip(place[:, 0], -pitch.length, pitch.length),
                np.clip(place[:, 1], -pitch.width, pitch.width),
            )
    return place.reshape(pixels.shape)


def _image_heights(keypoints: AnyFloats, boxes: AnyFloats) -> Floats:
    """Return the height of people in the image [px] (...), by box, or by keypoints without one."""
    y = np.asarray(keypoints[..., 1], dtype=np.float64)
    known = np.isfinite(y)
    spread = np.where(known, y, -np.inf).max(axis=-1) - np.where(known, y, np.inf).min(axis=-1)
    by_box = np.asarray(boxes[..., 3] - boxes[..., 1], dtype=np.float64)
    return np.asarray(np.where(np.isnan(by_box), spread, by_box))


def _foot_noise(camera: Camera, place: Floats, height_std: Floats, size: Floats) -> Floats:
    """Return the covariance (..., 2, 2) [m^2] of places by the error of feet in the image."""
    offset = place - camera.center[:2]
    distance = np.linalg.norm(offset, axis=-1)
    # Standard deviation of the middle of the feet from the mid-hip, across the line of sight [m].
    across_std = 0.09
    with np.errstate(invalid="ignore", divide="ignore"):
        along = offset / distance[..., None]
        slope = camera.center[2] / distance  # tangent of the elevation
        pixel = (PIXEL_STD + PIXEL_SHARE * size) / camera.focal.mean()
        reach = np.hypot(distance, camera.center[2])
        sine = camera.center[2] / reach
        across_variance = across_std**2 + (pixel * reach) ** 2
        along_variance = across_std**2 + (height_std / slope) ** 2 + (pixel * reach / sine) ** 2
    outer = along[..., :, None] * along[..., None, :]
    return np.asarray(
        along_variance[..., None, None] * outer
        + across_variance[..., None, None] * (np.eye(2) - outer)
    )
