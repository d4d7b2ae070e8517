"""Clock offsets of cameras over a clip: constants, drifts and steps, of all cameras together.

Residuals in a bin b of frames give normal equations (M_b, s_b) of the clocks [frame] and views of
all cameras, with the joints free to follow (`sum_equations`). The offsets are A_b x, of sizes x of
the parts of courses and of constant errors of views; these minimise

    sum_b (A_b x)^T M_b (A_b x) - 2 (A_b x)^T (s_b + M_b A_b x_0),

with the present sizes x_0. A further part with a column a_b lowers the sum by g^2 / K,

    g = sum_b a_b^T r_b,  K = sum_b a_b^T M_b a_b - P^T N^-1 P,  P = sum_b A_b^T M_b a_b,

with what is left, r_b, and the normal matrix N of all other parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, Literal, Self

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.clocks import (
    MovingJoints,
    move_to_match_time,
    shift_in_time,
    sum_equations,
)
from worldpose.triangulation.lost_views import find_lost_views
from worldpose.triangulation.residuals import Rig
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.synchronization import PRIOR, synchronize

MIN_FRAMES: Final = {"drift": 0.4, "step": 0.6}
"""Least size of a part [frame]: a recorder loses whole frames, and the errors that views
share differ between the ends of a clip."""
MIN_GAIN: Final = 30.0
"""Least decrease of the sum of squares by a drift or a step, in variances of the noise [1]."""
Course = list[tuple[int, float]]
"""Clock offset of a camera: rising rows of a clip with values [frame], linear between them."""


@dataclass(frozen=True)
class ClockPart:
    """A part of the clock offset of a camera: its size [frame] times its share at a row."""

    camera: int
    kind: Literal["constant", "drift", "step"]
    row: int
    """Row of the first frame after a step."""
    size: float
    """[frame]; of a drift, over the whole clip."""

    def share(self, rows: Floats | Integers, frames: int) -> Floats:
        """Return the share (n,) at rows of a clip of some frames."""
        if self.kind == "drift":
            return np.asarray(rows / max(1.0, frames - 1.0))
        return np.asarray(rows >= self.row, dtype=np.float64)

    def knots(self, frames: int) -> tuple[int, ...]:
        """Return the rows between which the part is linear."""
        if self.kind == "drift":
            return (0, frames - 1)
        return (0, self.row - 1, self.row) if self.kind == "step" else (0,)


@dataclass(frozen=True, eq=False)
class ClockSums:
    """Normal equations of all cameras in bins of frames; unknowns as of `sum_equations`.

    Attributes:
        matrix: (bins, unknowns, unknowns).
        score: (bins, unknowns).
        rows: (bins,) middle of each bin [frame].
    """

    matrix: Floats
    score: Floats
    rows: Floats

    @classmethod
    def of(cls, rig: Rig, people: KeypointDetections, fps: float, rows: slice, length: int) -> Self:
        """Return the equations of bins of `length` rows of tracked people on the common clock."""
        # Deviations accepted: clocks may be frames apart.
        settings = TriangulationSettings(max_deviation=10.0)
        frames, half = len(people.detection_index), max(1, round(0.06 * fps))
        sums, chunk = [], length * max(1, round(1.0 * fps / length))
        for start in range(rows.start, rows.stop, chunk):
            part = slice(max(0, start - half), min(frames, start + chunk + half, rows.stop + half))
            seen = people[part]
            moving = MovingJoints.find(rig, shift_in_time(seen, np.zeros(1)), fps, settings)
            if len(moving.at):
                bins = (moving.frame + part.start) // length
                added = sum_equations(replace(moving, person=bins), with_cameras=True)
                sums.append((np.unique(bins), added))
        if not sums:
            return cls(np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros(0))
        middles = np.concatenate([bins for bins, _ in sums]) * length + 0.5 * (length - 1)
        each = [one for _, one in sums]
        return cls(
            np.concatenate([one.information for one in each]),
            np.concatenate([one.score for one in each]),
            np.asarray(middles),
        )

    def noise(self, fps: float) -> Floats:
        """Return the variance of a clock in seconds about its neighbours (cameras,) [1]."""
        count = self.score.shape[1] // 5
        second = np.floor(self.rows / max(1.0, round(fps)))
        first = np.flatnonzero(np.diff(second, prepend=-1.0))
        # All cameras together: what changes in one shows in none of the others.
        prior = np.tile([1e-2, *PRIOR], count)
        inverse = np.linalg.inv(np.add.reduceat(self.matrix, first) + np.diag(prior))
        late = (inverse @ np.add.reduceat(self.score, first)[..., None])[:, ::5, 0]
        own = np.diagonal(inverse, axis1=1, axis2=2)[:, ::5]
        off = late[1:-1] - 0.5 * (late[:-2] + late[2:])
        if not len(off):
            return np.ones(count)
        variance = own[1:-1] + 0.25 * (own[:-2] + own[2:])
        # The median of a squared standard normal variable is 0.455.
        return np.asarray(np.maximum(1.0, np.median(off**2 / variance, axis=0) / 0.455))


def trace_clocks(
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    late: Floats,
    *,
    pitch_size: tuple[float, float] | None = None,
) -> list[Course]:
    """Return the clock offset of each camera over a clip, with steps and drifts.

    People are tracked and triangulated with the clocks so far. Changes that the tracker cannot
    follow are added, or else the clearest of the others; then the steps and drifts of all cameras
    are fitted together, until there is none.

    Args:
        cameras: batch (cameras,), at least three.
        detections: (frames, cameras, detections) in memory, before tracking.
        fps: frames per second [1/s].
        late: (cameras,) constant offset to start from [frame].
        pitch_size: length and width of the pitch that people stand on [m]; None = not known.
    """
    frames, count = detections.score.shape[:2]
    rig, length = Rig.from_cameras(cameras), max(1, round(0.2 * fps))
    parts = [ClockPart(c, "constant", 0, float(value)) for c, value in enumerate(late)]
    for _ in range(2 * count + 6):
        shifted, rest = shift_by_courses(detections, _courses(parts, count, frames))
        tracks = track_people(cameras, shifted, fps, TrackingSettings(), pitch_size=pitch_size)
        if lost := find_lost_views(cameras, shifted, tracks.joints, fps, ("clock",)):
            found, late_frames = lost[0].found, float(lost[0].amount[4])
            parts.append(ClockPart(found.camera, "step", found.row, late_frames))
            continue
        index = tracks.detection_index
        moved = move_to_match_time(np.asarray(shifted.keypoints, np.float64), index, rest)
        # More people cost time and tell little more.
        every = 1 + index.size // 300_000
        people = replace(shifted, keypoints=moved, detection_index=index[:, :, ::every])
        sums = ClockSums.of(rig, people, fps, slice(0, frames), length)
        if not len(sums.rows):
            break
        fitted = fit_parts(sums, _place_steps(rig, people, fps, parts), frames, fps)
        if len(fitted) == len(parts) == count or _is_settled(parts, fitted):
            break
        # A common offset changes no residual: most clocks keep theirs.
        common = np.median([fitted[c].size - parts[c].size for c in range(count)])
        parts = [
            replace(part, size=part.size - common * (part.kind == "constant")) for part in fitted
        ]
    return _courses(parts, count, frames)


def add_slow_drifts(
    courses: Sequence[Course],
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    *,
    max_offset_s: float,
    pitch: PitchTemplate | None = None,
) -> list[Course]:
    """Return courses with drifts that both ends of a clip show, such as 29.97 beside 30.

    `trace_clocks` sees changes within a second; these are a frame in half a minute. Arguments are
    those of `worldpose.triangulation.synchronization.synchronize`.
    """
    # Least difference of the ends in standard deviations [1], and in frames; their length [s].
    min_score, min_frames, end_s = 5.0, 0.25, 30.0
    frames = len(detections.frame)
    span = min(frames // 2, round(end_s * fps))
    if span < 2:
        return list(courses)
    late, std, groups = [], [], []
    for rows in (slice(0, span), slice(frames - span, frames)):
        found = synchronize(cameras, detections[rows], fps, max_offset_s=max_offset_s, pitch=pitch)
        late.append(found.late)
        std.append(found.std)
        groups.append(found.groups)
    change = late[1] - late[0]
    for group in groups[0]:
        # Each end has its own zero, the median of the cameras whose offset it knows.
        both = [c for c in group if np.isfinite(change[c])]
        change[both] -= np.median(change[both]) if both else 0.0
    drifts = np.abs(change) > np.maximum(min_score * np.hypot(*std), min_frames)
    end = 0.5 * (frames - 1) / (frames - span) * change
    return [
        [(0, course[0][1] - float(end[c])), (frames - 1, course[0][1] + float(end[c]))]
        if drifts[c] and len(course) == 1
        else course
        for c, course in enumerate(courses)
    ]


def shift_by_courses(
    detections: KeypointDetections, courses: Sequence[Course]
) -> tuple[KeypointDetections, Floats]:
    """Return the nearest frames on the common clock, and what is left of the offsets [frame].

    Detections are (frames, cameras, detections), offsets that are left (frames, cameras).
    """
    frames, count = detections.score.shape[:2]
    frame = np.arange(frames)
    course = np.stack([np.interp(frame, *np.array(each).T) for each in courses], axis=1)
    row = np.floor(frame[:, None] - course + 0.5).astype(np.int64)
    outside = (row < 0) | (row >= frames)
    row = np.clip(row, 0, frames - 1)
    arrays = {}
    for name, array in detections.arrays().items():
        arrays[name] = array[row, np.arange(count)].astype(np.float64)
        arrays[name][outside] = np.nan
    rest = row + course - frame[:, None]
    rest = np.where(np.abs(rest) < 1.0, rest, 0.0)
    return detections.with_arrays(arrays, frame), rest


def _is_settled(before: Sequence[ClockPart], after: Sequence[ClockPart]) -> bool:
    """Return whether parts stay the same, to a small part of a frame."""
    moved = [a.size - b.size for a, b in zip(before, after, strict=False)]
    same = [replace(part, size=0.0) for part in before] == [replace(p, size=0.0) for p in after]
    return same and float(np.abs(moved).max()) < 0.02


def fit_parts(
    sums: ClockSums, parts: Sequence[ClockPart], frames: int, fps: float
) -> list[ClockPart]:
    """Return the parts of courses that all cameras show, with their sizes.

    Parts are added, the clearest first, and dropped where the others explain what they did.
    """
    late = np.zeros_like(sums.score)
    there = np.ones(len(sums.rows), np.bool_)
    for part in parts:
        late[:, 5 * part.camera] += part.size * part.share(sums.rows, frames)
        if part.kind == "step":  # its place is known to some frames, and lost frames have no image
            there &= np.abs(sums.rows - part.row) > 0.2 * fps + max(0.0, part.size)
    if not there.any():  # a clip that is shorter than what a step leaves open
        return list(parts)
    full = sums.score + (sums.matrix @ late[..., None])[..., 0]  # of clocks that are not corrected
    sums = ClockSums(sums.matrix[there], full[there], sums.rows[there])
    parts, most, noise = list(parts), len(parts) + 4, sums.noise(fps)
    while True:
        fit = _Fit.of(sums, parts, frames)
        weak = [
            k
            for k, part in enumerate(parts)
            if part.kind != "constant"
            and (
                abs(fit.sizes[k]) < MIN_FRAMES[part.kind]
                or fit.sizes[k] ** 2 < MIN_GAIN * noise[part.camera] * fit.covariance[k, k]
            )
        ]
        if weak:
            parts.pop(min(weak, key=lambda k: fit.sizes[k] ** 2 / fit.covariance[k, k]))
            most -= 1
            continue
        parts = [replace(part, size=float(x)) for part, x in zip(parts, fit.sizes, strict=False)]
        further = fit.find_part(noise, fps) if len(parts) < most else None
        if further is not None:
            parts.append(further)
            continue
        # Steps in a row look like a drift.
        steps = [part for part in parts if part.kind == "step"]
        others = [
            [
                *(part for part in parts if part not in (one, other)),
                replace(one, kind="drift", row=0),
            ]
            for one, other in product(steps, steps)
            if one.camera == other.camera
            and not any(part.camera == one.camera and part.kind == "drift" for part in parts)
        ]
        costs = [
            MIN_GAIN * noise[each[-1].camera] * len(each) - _Fit.of(sums, each, frames).gain
            for each in others
        ]
        k = int(np.argmin(costs)) if costs else 0
        if not costs or costs[k] >= MIN_GAIN * noise[others[k][-1].camera] * len(parts) - fit.gain:
            return parts
        parts = others[k]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Parts of courses, fitted to sums: the module's equations.

    Attributes:
        sums: the equations.
        frames: of the clip.
        columns: (bins, unknowns, parts + views), A.
        sizes: (parts + views,), x.
        covariance: of the sizes, N^-1.
        left: (bins, unknowns), r.
        gain: decrease of the sum of squares by the parts [1].
    """

    sums: ClockSums
    frames: int
    columns: Floats
    sizes: Floats
    covariance: Floats
    left: Floats
    gain: float

    @classmethod
    def of(cls, sums: ClockSums, parts: Sequence[ClockPart], frames: int) -> Self:
        """Fit the sizes of all parts together."""
        unknowns, count = sums.score.shape[1], sums.score.shape[1] // 5
        columns = np.zeros((len(sums.rows), unknowns, len(parts) + 4 * count))
        for k, part in enumerate(parts):
            columns[:, 5 * part.camera, k] = part.share(sums.rows, frames)
        views = np.flatnonzero(np.arange(unknowns) % 5)
        columns[:, views, len(parts) + np.arange(4 * count)] = 1.0
        known = np.array([*(part.size for part in parts), *np.zeros(4 * count)])
        prior = np.array([*(1e-2 for _ in parts), *np.tile(PRIOR, count)])
        held = sums.matrix @ columns
        inverse = np.linalg.inv(np.einsum("buk,bul->kl", columns, held) + np.diag(prior))
        pull = np.einsum("buk,bu->k", columns, sums.score) + prior * known
        sizes = inverse @ pull
        left = sums.score - held @ sizes
        return cls(sums, frames, columns, sizes, inverse, left, float(pull @ sizes))

    def find_part(self, noise: Floats, fps: float) -> ClockPart | None:
        """Return the part that lowers the sum of squares most; None if none is clear."""
        rows = self.sums.rows
        margin = 0.6 * fps  # from a step to the ends of the clip
        steps = np.ceil(rows[(rows > rows[0] + margin) & (rows < rows[-1] - margin)]).astype(int)
        best, most = None, 0.0
        for c in range(len(noise)):
            own = self.sums.matrix[:, :, 5 * c]
            follow = np.einsum("buk,bu->bk", self.columns, own)
            pull, held = self.left[:, 5 * c], own[:, 5 * c]
            drift = ClockPart(c, "drift", 0, 0.0)
            for part in (drift, *(ClockPart(c, "step", row, 0.0) for row in steps.tolist())):
                share = part.share(rows, self.frames)
                fixed = share @ follow
                total = float(share**2 @ held)
                stays = total - float(fixed @ self.covariance @ fixed)
                if stays <= 1e-3 * total:
                    continue
                size = float(share @ pull) / stays
                gain = size**2 * stays
                is_clear = gain > MIN_GAIN * noise[c] and abs(size) >= MIN_FRAMES[part.kind]
                if gain > most and is_clear and self._is_sharp(part, noise, fps):
                    best, most = part, gain
        return best

    def _is_sharp(self, part: ClockPart, noise: Floats, fps: float) -> bool:
        """Return whether a step stands out in the seconds around it."""
        if part.kind == "drift":
            return True
        own, off = 5 * part.camera, self.sums.rows - part.row
        late, held = [], []
        for side in ((off < 0) & (off > -3.0 * fps), (off >= 0) & (off < 3.0 * fps)):
            held.append(float(self.sums.matrix[side, own, own].sum()) + 1e-9)
            late.append(float(self.left[side, own].sum()) / held[-1])
        gain = (late[1] - late[0]) ** 2 / (1.0 / held[0] + 1.0 / held[1])
        return bool(gain > 12.0 * noise[part.camera])


def _place_steps(
    rig: Rig, people: KeypointDetections, fps: float, parts: Sequence[ClockPart]
) -> list[ClockPart]:
    """Return the parts with each step at the row that the frames around it show."""
    frames, near = len(people.detection_index), round(0.6 * fps)
    placed = list(parts)
    for k, part in enumerate(parts):
        if part.kind != "step":
            continue
        rows = slice(max(0, part.row - near), min(frames, part.row + near))
        sums = ClockSums.of(rig, people, fps, rows, 1)
        if not len(sums.rows):
            continue
        own = 5 * part.camera
        held = sums.matrix[:, own, own] + 1e-9
        late = sums.score[:, own] / held + part.size * part.share(sums.rows, frames)
        # Each row of a step, with a free constant: errors of the calibration last.
        off = late - part.size * (sums.rows >= sums.rows[:, None])
        off -= (off @ held)[:, None] / held.sum()
        cost = off**2 @ held
        row, gain = int(sums.rows[int(np.argmin(cost))]), cost[sums.rows == part.row] - cost.min()
        # Lost frames have no image: any row among them is as good.
        is_far = abs(row - part.row) > 1.0 + max(0.0, part.size)
        if is_far and row > sums.rows[0] and (gain > MIN_GAIN).any():
            placed[k] = replace(part, row=row)
    return placed


def _courses(parts: Sequence[ClockPart], cameras: int, frames: int) -> list[Course]:
    """Return the courses of all cameras."""
    courses: list[Course] = []
    for c in range(cameras):
        own = [part for part in parts if part.camera == c]
        rows = {row for part in own for row in part.knots(frames)}
        at = np.array(sorted(rows))
        values = np.sum([part.size * part.share(at, frames) for part in own], axis=0)
        courses.append([(int(a), float(b)) for a, b in zip(at, values, strict=True)])
    return courses
