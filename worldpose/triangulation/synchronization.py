"""Clock offsets of cameras that nothing is known of, from the people who move in their views.

Whole frames are searched by how many detections of two cameras meet in 3D; the remainder is
estimated from tracks (`estimate_clocks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.comparison import Comparison
from worldpose.camera_consistency.consistency import select_busiest_frames
from worldpose.camera_consistency.hypotheses import STATED
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.tracking.plane.clocks import estimate_plane_clocks
from worldpose.tracking.plane.feet import locate_feet
from worldpose.tracking.ray_matching import require_clip
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.clocks import (
    GATES,
    SETTLED,
    MovingJoints,
    PersonSums,
    shift_in_time,
    sum_equations,
)
from worldpose.triangulation.residuals import Rig
from worldpose.triangulation.samples import choose_intervals, have_views
from worldpose.triangulation.settings import TriangulationSettings

MAX_SPAN: Final = 30
"""Largest distance from the best to another likely shift [frame]: the people's motion leads from
there to the right one."""
PRIOR: Final = (*(1.0 / 0.003**2,) * 3, 1.0 / 0.005**2)
"""Information on rotation [1/rad^2] and on the logarithm of the focal length [1]: calibrations are
expected to be within 3 mrad and 0.5 %."""


@dataclass(frozen=True, eq=False)
class Synchronization:
    """Clock offsets of a clip's cameras.

    Attributes:
        late: (cameras,) [frame]: frame t shows the time t + late, relative to the other cameras of
            its group; NaN where not determined.
        std: (cameras,) standard deviation [frame]; infinite where not determined.
        reasons: why the offset of each camera is not determined; empty where it is.
        shifts: (n,) compared offsets [frame].
        groups: cameras that share people, in order; groups share none.
        matches: (cameras, n) people of a camera who meet those of all others at each offset, with
            the others at their own offsets [persons per frame]; NaN where not determined.
    """

    late: Floats
    std: Floats
    reasons: tuple[str, ...]
    shifts: Integers
    matches: Floats
    groups: tuple[tuple[int, ...], ...] = ()


def synchronize(
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    *,
    max_offset_s: float = 2.0,
    pitch: PitchTemplate | None = None,
) -> Synchronization:
    """Return the clock offset of every camera, without any prior knowledge of it.

    The offset of two cameras is the one at which most of their people meet in 3D. Cameras are added
    one by one, the clearest first. Then people are tracked with whole offsets, and the remainder is
    estimated from their motion. Where no two cameras see people from different directions, their
    places on the pitch are compared (`estimate_plane_clocks`). A camera that shows no motion, or no
    person whom another shows, has no offset.

    Detections (frames, cameras, detections) are in memory, before tracking. Two cameras differ by
    `max_offset_s` [s] at most, and by half of the clip. People stand on the pitch; None = anywhere.
    InputError for fewer than two cameras, or shapes that do not fit together.
    """
    require_clip("synchronization", cameras, detections, least=2)
    confidence, count = detections.confidence, len(cameras.focal)
    # Longest part of a clip that is compared, the one with the most people [s].
    longest = round((30.0 + 2.0 * max_offset_s) * fps)
    detections = detections[select_busiest_frames(confidence, longest)]
    keypoints, confidence = detections.keypoints, detections.confidence
    points = np.where((confidence > 0.0)[..., None], keypoints, np.nan).astype(np.float64)
    most = min(round(max_offset_s * fps), len(points) // 2)
    table = _Table(cameras, points, fps, most, ground=pitch is not None)
    whole, span, reasons, groups = table.solve()
    late, std = whole.astype(np.float64), np.full(count, np.inf)
    known = np.isfinite(span)
    for group in groups:
        chosen = np.array([camera for camera in group if known[camera]], dtype=np.int64)
        if len(chosen) >= 2:
            late[chosen], std[chosen] = _refine(
                cameras[chosen], detections, fps, chosen, whole[chosen], pitch
            )
    # Largest standard error of a determined offset [frame]: twice of it is half a frame.
    known &= (std <= 0.25) & (np.abs(late - whole) <= MAX_SPAN)
    for camera in np.flatnonzero(~known & np.isfinite(span)):
        reasons[camera] = (
            "its people move too little, or other cameras contradict each other about it"
        )
    std[~known] = np.inf
    if not known.any() and pitch is not None:
        late, std, groups = _compare_places(cameras, detections, fps, pitch, max_offset_s)
        known = np.isfinite(std)
        reasons = ["" if told else reason for told, reason in zip(known, reasons, strict=True)]
    groups = [[camera for camera in sorted(group) if known[camera]] for group in groups]
    groups = sorted(group for group in groups if len(group) > 1)
    matches = np.full((count, len(table.shifts)), np.nan)
    for group in groups:
        late[group] -= np.median(late[group])
        matches[group] = table.curves(np.rint(late).astype(np.int64), group)
    joined = np.isin(np.arange(count), [camera for group in groups for camera in group])
    late, std = np.where(joined, late, np.nan), np.where(joined, std, np.inf)
    each = tuple(tuple(group) for group in groups)
    return Synchronization(late, std, tuple(reasons), table.shifts, matches, each)


def _compare_places(
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    pitch: PitchTemplate,
    max_offset_s: float,
) -> tuple[Floats, Floats, list[list[int]]]:
    """Return offsets, standard deviations [frame] and groups by places of runners on the pitch."""
    clocks = estimate_plane_clocks(
        locate_feet(cameras, detections, pitch),
        fps,
        pitch_size=(pitch.length, pitch.width),
        max_offset_s=max_offset_s,
    )
    # Largest standard error; places on the pitch are less accurate than joints.
    told = clocks.runs & (clocks.std * fps <= 0.5)
    members = ([c for c in group if told[c]] for group in clocks.groups)
    groups = [group for group in members if len(group) > 1]
    known = np.isin(np.arange(len(told)), list(chain(*groups)))
    return clocks.seconds * fps, np.where(known, clocks.std * fps, np.inf), groups


def _refine(
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    chosen: Integers,
    whole: Integers,
    pitch: PitchTemplate | None,
) -> tuple[Floats, Floats]:
    """Return the offsets of the chosen cameras with their fraction, and standard errors [frame]."""
    late, error = whole.astype(np.float64), np.full(len(chosen), np.inf)
    pitch_size = None if pitch is None else (pitch.length, pitch.width)
    for _ in range(6):
        steps = np.rint(late).astype(np.int64)
        shifted = shift_frames(detections, chosen, steps)
        tracks = track_people(cameras, shifted, fps, TrackingSettings(), pitch_size=pitch_size)
        people = shifted.assign_people(tracks.detection_index)
        rest, error = _estimate_fractions(cameras, people, fps)
        late = steps + rest
        if (np.rint(late) == steps).all():
            break
    return late, np.hypot(error, _disagreement(cameras, people, fps, rest, error))


def _disagreement(
    cameras: Camera, people: KeypointDetections, fps: float, late: Floats, error: Floats
) -> Floats:
    """Return the standard error of each offset from the choice of the other cameras [frame].

    Other errors of an offset are the same at all times and in all people, such as a place of the
    camera that is not where the calibration has it, and no scatter shows them. But they are not
    the same towards all other cameras. The standard error is that of the jackknife over groups of
    cameras, of the part of each change that the smaller number of cameras does not explain.
    """
    count = len(late)
    # Most groups of cameras that are left out in turn; more cost more time than they tell.
    group = np.arange(count) % min(count, 6)
    changes = np.full((int(group.max()) + 1, count), np.nan)
    for one in range(len(changes)):
        rest = np.flatnonzero(group != one)
        if len(rest) < 2:
            continue
        arrays = {name: array[:, rest] for name, array in people.arrays().items()}
        index = people.detection_index[:, rest]
        seen = replace(people.with_arrays(arrays, people.frame), detection_index=index)
        found, uncertain = _estimate_fractions(cameras[rest], seen, fps)
        told = np.isfinite(uncertain) & np.isfinite(error[rest])
        if np.count_nonzero(told) < 2:
            continue
        rest, found, uncertain = rest[told], found[told], uncertain[told]
        change = found - found.mean() - (late[rest] - late[rest].mean())
        explained = np.maximum(uncertain**2 - error[rest] ** 2, 0.0)
        changes[one, rest] = np.maximum(change**2 - explained, 0.0)
    known = np.isfinite(changes).sum(axis=0)
    total = np.nansum(changes, axis=0) * (known - 1) / np.maximum(known, 1)
    return np.asarray(np.where(known >= 2, np.sqrt(np.maximum(total, 0.0)), 0.0))


def _estimate_fractions(
    cameras: Camera, people: KeypointDetections, fps: float
) -> tuple[Floats, Floats]:
    """Return clock offsets of a few frames at most, and standard errors [frame].

    As in `estimate_clocks`, residuals are regressed on the people's image motion. Here the
    orientation and the focal length of each camera are unknown, too: an error of the calibration
    that moves people by a few centimetres is not taken for one of the clock.
    """
    settings = TriangulationSettings()
    count = int(cameras.batch_shape[0])
    late, error = np.zeros(count), np.full(count, np.inf)
    # Length of an interval [s]; a person's errors within an interval count as one.
    length = max(3, round(0.5 * fps))
    unknown_clock = 10.0  # Standard deviation of a clock offset beyond whole frames [frame].
    # Unknowns of a camera: clock, rotation, logarithm of the focal length.
    unknowns = 5
    for gate in GATES:
        loose = settings.model_copy(update={"max_deviation": gate})
        common = shift_in_time(people, late)
        rig = Rig.from_cameras(cameras)
        intervals = choose_intervals(have_views(people, 2), length)
        parts = [
            sum_equations(MovingJoints.find(rig, common[part], fps, loose), with_cameras=True)
            for part in intervals
        ]
        groups = sum(len(part.score) for part in parts)
        if not groups:
            break
        sums = PersonSums.join(parts)
        information, score = sums.information, sums.score
        prior = np.tile([1.0 / unknown_clock**2, *PRIOR], count)
        inverse = np.linalg.inv(information.sum(axis=0) + np.diag(prior))
        step = inverse @ score.sum(axis=0)
        clock = slice(None, None, unknowns)
        # A common offset moves people along their path and changes no residual.
        told = np.diagonal(information.sum(axis=0))[clock] > 1.0 / unknown_clock**2
        rows = inverse[clock] - told @ inverse[clock] / max(1, told.sum())
        left = (score - information @ step) @ rows.T
        stated = np.diagonal(rows @ information.sum(axis=0) @ rows.T)
        scatter = (left**2).sum(axis=0) * groups / max(1, groups - 1)
        # The common error of all people in a camera does not show in their scatter.
        alike = rows[:, clock] ** 2 @ sums.common_score() ** 2
        # A rotation that the people do not tell is as uncertain as its prior.
        assumed = rows**2 @ prior
        error = np.sqrt(np.maximum(scatter, stated) + alike + assumed)
        error = np.where(told, error, np.inf)
        change = np.where(told, step[clock], 0.0)
        change = np.clip(change - np.median(change[told]) if told.any() else change, -3.0, 3.0)
        late += np.where(told, change, 0.0)
        if np.abs(change).max() < SETTLED and gate == GATES[-1]:
            break
    return late, error


def shift_frames(
    detections: KeypointDetections, chosen: Integers, late: Integers
) -> KeypointDetections:
    """Return detections of some cameras on the common clock, shifted by whole frames.

    Detections are (frames, cameras, detections); frame t of the chosen cameras (n,) shows the time
    t + late, with `late` (n,) [frame].
    """
    frames = len(detections.keypoints)
    arrays = {}
    for name, array in detections.arrays().items():
        moved = np.full((frames, len(chosen), *array.shape[2:]), np.nan)
        for k, (camera, step) in enumerate(zip(chosen, late, strict=True)):
            rows = np.arange(frames) - step
            inside = (rows >= 0) & (rows < frames)
            moved[inside, k] = array[rows[inside], camera]
        arrays[name] = moved
    return detections.with_arrays(arrays, np.arange(frames))


class _Table:
    """Matches of every two cameras by moment and shift.

    Attributes:
        shifts: (n,) of the second camera [frame].
        scores: by pair of cameras (a, b), a < b, (n, moments): matches of a at each moment with b
            `shift` frames later; NaN where b has no such frame.
    """

    def __init__(
        self, cameras: Camera, points: Floats, fps: float, most: int, *, ground: bool
    ) -> None:
        # Frames of a camera that are compared with every shift of another.
        settings = ConsistencySettings(sample_frames=60)
        noise = np.full(int(cameras.batch_shape[0]), settings.pixel_noise_px)
        # Standard deviation of a detector's joint on the body [m]: less than usual, so that people
        # who move slowly stop to match soon.
        comparison = Comparison(cameras, noise, points, ground, settings, 0.025)
        self.count, self.most = comparison.count, most
        self.shifts = np.arange(-most, most + 1)
        moments = comparison.sample
        # Frames nearer to each other count as one observation [s].
        blocks = np.maximum(1, round(0.25 * fps))
        self._block = np.unique(moments // blocks, return_inverse=True)[1]
        frames = np.arange(comparison.frames)
        there = moments[None] + self.shifts[:, None]
        inside = (there >= 0) & (there < comparison.frames)
        # Least share of these frames that a shift leaves within the other camera's clip [1].
        inside[inside.mean(axis=1) < 0.3] = False
        at = np.broadcast_to(np.arange(len(moments)), there.shape)[inside]
        every = [comparison.view(c, STATED, frames) for c in range(self.count)]
        self.scores: dict[tuple[int, int], Floats] = {}
        for a, b in combinations(range(self.count), 2):
            found = comparison.scores(comparison.views[a], every[b], at, there[inside])
            table = np.full(there.shape, np.nan)
            table[inside] = found
            self.scores[a, b] = table

    def solve(self) -> tuple[Integers, Floats, list[str], list[list[int]]]:
        """Return whole offsets, the distance of other likely ones, reasons, and groups.

        The distance is infinite where no offset is known [frame].
        """
        blocks = int(self._block.max()) + 1
        rng = np.random.default_rng(0)
        # Repetitions with other observations (bootstrap).
        draws = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), 200)
        curves = self._means(np.ones((1, blocks)))
        drawn = self._means(draws.astype(np.float64))
        groups, late, reasons = self._join(curves, drawn)
        span = np.full(self.count, np.inf)
        for order, camera in ((group, camera) for group in groups for camera in group):
            own = self._total(curves, camera, late, order)[0]
            others = self._total(drawn, camera, late, order)
            best = int(np.nanargmax(own))
            late[camera] = self.shifts[best]
            change = others[:, best, None] - others
            drawn_once = np.isfinite(change).any(axis=0)  # other shifts are no candidates
            error = np.full(len(self.shifts), np.nan)
            error[drawn_once] = np.nanstd(change[:, drawn_once], axis=0)
            # A shift is excluded if it is worse than the best by this many standard errors.
            likely = self.shifts[own[best] - own <= 2.0 * error + 1e-9]
            span[camera] = float(np.abs(likely - self.shifts[best]).max(initial=0))
            if span[camera] > MAX_SPAN:
                ends = f"{likely.min():+d} to {likely.max():+d}"
                reasons[camera] = f"offsets of {ends} frames explain its people equally well"
                span[camera] = np.inf
        return late, span, reasons, groups

    def curves(self, late: Integers, group: Sequence[int]) -> Floats:
        """Return the matches (members, n) of each camera of a group with the others by offset."""
        means = self._means(np.ones((1, int(self._block.max()) + 1)))
        return np.stack([self._total(means, camera, late, group)[0] for camera in group])

    def _means(self, weights: Floats) -> dict[tuple[int, int], Floats]:
        """Return mean matches (draws, n) of each pair; weights are (draws, blocks)."""
        by_moment = weights[:, self._block]
        means = {}
        for pair, table in self.scores.items():
            known = np.isfinite(table)
            total = by_moment @ np.where(known, table, 0.0).T
            number = by_moment @ known.T
            with np.errstate(invalid="ignore", divide="ignore"):
                means[pair] = np.where(number > 0.0, total / number, np.nan)
        return means

    def _total(
        self,
        means: dict[tuple[int, int], Floats],
        camera: int,
        late: Integers,
        others: Sequence[int],
    ) -> Floats:
        """Return the matches (draws, n) of a camera with others, by its offset from -most on."""
        draws = next(iter(means.values())).shape[0]
        total = np.full((draws, len(self.shifts)), np.nan)
        for other in others:
            if other == camera:
                continue
            a, b = sorted((camera, other))
            # Frame t of a shows what frame t + late[a] - late[b] of b shows.
            wanted = self.shifts - late[other] if camera == a else late[other] - self.shifts
            inside = np.abs(wanted) <= self.most
            part = np.full_like(total, np.nan)
            part[:, inside] = means[a, b][:, wanted[inside] + self.most]
            usual = np.nanmedian(means[a, b], axis=1, keepdims=True)
            total = np.where(
                np.isfinite(part), np.where(np.isfinite(total), total, 0.0) + part - usual, total
            )
        return total

    def _join(
        self, curves: dict[tuple[int, int], Floats], drawn: dict[tuple[int, int], Floats]
    ) -> tuple[list[list[int]], Integers, list[str]]:
        """Return groups of cameras in the order of clearness, their offsets, and reasons."""
        late = np.zeros(self.count, dtype=np.int64)
        reasons = [
            "no offset stands out: its people move too little, or no other camera shows them"
        ] * self.count
        clearness = {pair: _contrast(curves[pair][0], drawn[pair]) for pair in curves}
        # Least peak of a camera's matches above the median shift, in standard errors [1]. By
        # chance one of 200 shifts of 153 pairs of cameras passes 5.4 in one of a thousand clips.
        min_contrast = 6.0
        groups: list[list[int]] = []
        while True:
            apart = [c for c in range(self.count) if all(c not in group for group in groups)]
            pairs = [pair for pair in combinations(apart, 2) if clearness[pair] >= min_contrast]
            if not pairs:
                break
            order = [max(pairs, key=lambda pair: clearness[pair])[0]]
            while len(order) < len(apart):
                rest = [c for c in apart if c not in order]
                totals = {c: self._total(curves, c, late, order)[0] for c in rest}
                clear = {c: _contrast(totals[c], self._total(drawn, c, late, order)) for c in rest}
                chosen = max(clear, key=lambda c: clear[c])
                if clear[chosen] < min_contrast:
                    break
                late[chosen] = self.shifts[int(np.nanargmax(totals[chosen]))]
                order.append(chosen)
            groups.append(order)
        groups = [group for group in groups if len(group) > 1]
        for camera in (camera for group in groups for camera in group):
            reasons[camera] = ""
        return groups, late, reasons


def _contrast(curve: Floats, drawn: Floats) -> float:
    """Return how far the peak (n,) is above the median shift, in standard errors of draws."""
    if np.isfinite(curve).sum() < 3:
        return 0.0
    best = int(np.nanargmax(curve))
    above = drawn[:, best] - np.nanmedian(drawn, axis=1)
    error = float(above[np.isfinite(above)].std()) if np.isfinite(above).any() else np.inf
    return float(curve[best] - np.nanmedian(curve)) / max(error, 1e-3)
