"""Detectors of the second simulator: joint definitions, errors, and uninformative confidence.

An error has components that the first simulator lacks: definitions tied to limbs, bias with the
first and third harmonic of the azimuth and with the camera's elevation, resonant noise along limbs,
heavy tails, and grids of heatmaps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.conventions import COCO17_FLIP
from data_contracts.records import Record
from worldpose.body.occlusions import facing_axes
from worldpose.simulation.foreign.rigs import ForeignView
from worldpose.simulation.reference import Report, list_detections


class DetectorProfile(Record):
    """One family of detectors; spreads are standard deviations."""

    name: str
    definition: float = 0.025
    """Offset from the anatomical joint to the detector's joint, along each axis of its limb [m];
    the same for all people and cameras."""
    personal: float = 0.006
    """The same, for each person [m]."""
    low_hips: float = 0.0
    """Offset of the detector's hips below the joints' centres [m]."""
    wide_hips: float = 0.0
    """Offset of the detector's hips outward [m]."""
    view_bias: float = 0.007
    """Bias by azimuth, each of two harmonics [person height]."""
    height_bias: float = 0.012
    """Bias along the image's vertical by the sine of the camera's elevation [person height]."""
    noise: float = 0.017
    """Noise on a person 100 px tall [person height]; it is proportional to the -0.3rd power of the
    height in the image."""
    floor: float = 0.5
    """Minimum noise [px]."""
    resonance: tuple[float, float] = (0.08, 0.45)
    """Period of a joint's oscillating error, minimum and maximum [s]."""
    tail: float = 3.5
    """Degrees of freedom of the sudden part (Student's t) [1]."""
    sudden: float = 0.5
    """Share of the variance that is independent per frame [1]."""
    limbs: float = 0.45
    """Share of its parent's error in a joint's error [1]."""
    grid: float = 0.0
    """Spacing of the grid of reported positions [person height]; 0 = none."""
    swapped: float = 0.015
    """Share of person-frames with a left-right swap of one part; twice from behind [1]."""
    strayed: float = 0.01
    """Share of joints with temporary gross errors [1]: on another person, the other side, the
    limb."""
    joint_missed: float = 0.02
    """Share of visible joints left out [1]."""
    hidden_kept: float = 0.5
    """Share of hidden joints that are guessed [1]; the others are left out."""
    person_missed: float = 0.02
    """Share of person-frames without a detection [1]."""
    smallest: float = 24.0
    """Height at which half of the people in the image are found [px]."""
    merged: float = 0.4
    """Share of overlaps in which two people merge into one detection [1]."""
    ghosts: float = 0.4
    """Persistent false positives per camera, mean number [1]: a bush, a poster."""
    flashes: float = 0.03
    """False positives that last one frame, mean number per frame [1]."""
    duplicates: float = 0.006
    """Share of people reported twice [1]."""
    confidence: Literal["honest", "blind", "sure", "meek"] = "honest"
    """`honest` falls with the error, `blind` is independent of it, `sure` is always high, `meek` is
    honest in a small range."""


PROFILES: Final = {
    profile.name: profile
    for profile in (
        DetectorProfile(name="heatmap-large", noise=0.011, grid=0.004, view_bias=0.005),
        DetectorProfile(
            name="heatmap-small",
            noise=0.021,
            grid=1.0 / 64.0,
            low_hips=0.03,
            confidence="sure",
            strayed=0.015,
        ),
        DetectorProfile(
            name="regression",
            noise=0.02,
            sudden=0.15,
            limbs=0.8,
            resonance=(0.3, 1.2),
            hidden_kept=1.0,
            joint_missed=0.0,
            confidence="blind",
        ),
        DetectorProfile(
            name="bottom-up",
            noise=0.019,
            tail=2.6,
            wide_hips=0.02,
            strayed=0.03,
            merged=0.7,
            joint_missed=0.06,
            hidden_kept=0.15,
            confidence="meek",
        ),
        DetectorProfile(
            name="old-box",
            noise=0.025,
            floor=1.0,
            swapped=0.035,
            person_missed=0.06,
            ghosts=1.0,
            flashes=0.1,
            duplicates=0.02,
            low_hips=0.05,
            wide_hips=0.015,
        ),
        DetectorProfile(
            name="sports-tuned",
            noise=0.014,
            definition=0.02,
            swapped=0.006,
            smallest=15.0,
            merged=0.25,
            confidence="sure",
        ),
    )
}
"""Profiles by name; a match has one of them."""


_PARENT: Final = (5, 0, 0, 1, 2, 6, 5, 5, 6, 7, 8, 12, 11, 11, 12, 13, 14)
"""Parent joint of the limb that leads to each joint."""
_EASE: Final = np.array(
    [0.5, 0.45, 0.45, 0.6, 0.6, 0.9, 0.9, 1.0, 1.0, 1.25, 1.25, 1.3, 1.3, 1.05, 1.05, 1.15, 1.15]
)
"""Error of each joint relative to the average one [1]."""

_STICKMAN: Final = np.array(
    [
        *([0.0, 0.07], [0.02, 0.05], [-0.02, 0.05], [0.04, 0.06], [-0.04, 0.06]),
        *([0.1, 0.18], [-0.1, 0.18], [0.12, 0.34], [-0.12, 0.34], [0.12, 0.48], [-0.12, 0.48]),
        *([0.06, 0.5], [-0.06, 0.5], [0.07, 0.74], [-0.07, 0.74], [0.07, 0.95], [-0.07, 0.95]),
    ]
)
"""Across and down, of a person of height one who faces the camera."""


@dataclass(frozen=True, eq=False)
class Detector:
    """A profile with the values drawn for one match.

    Attributes:
        profile: rates and spreads.
        definition: (17, 3) offsets along the limb, to the left and across both [m].
        view_bias: (17, 2, 4) of cosine and sine of the first and third harmonic along the image
            axes [1].
        height_bias: (17,) [1].
    """

    profile: DetectorProfile
    definition: Floats
    view_bias: Floats
    height_bias: Floats

    @classmethod
    def draw(cls, profile: DetectorProfile, rng: np.random.Generator) -> Detector:
        """Return a detector of this profile; left and right are mirror images."""
        definition = profile.definition * rng.standard_normal((17, 3))
        height_bias = profile.height_bias * rng.standard_normal(17)
        for joint, mirror in enumerate(COCO17_FLIP):
            if mirror < joint:
                definition[joint] = definition[mirror] * [1.0, -1.0, 1.0]
                height_bias[joint] = height_bias[mirror]
        definition[0, 1] = 0.0
        view_bias = profile.view_bias * rng.standard_normal((17, 2, 4))
        return cls(profile, definition, view_bias, height_bias)

    def define(self, joints: Floats, personal: Floats) -> Floats:
        """Return the joints as the detector defines them (frames, persons, 17, 3) [m], world.

        `personal` (persons, 17, 3) are each person's own offsets, in units of the profile's.
        """
        _, left = facing_axes(joints)
        along = joints - joints[:, :, _PARENT]
        along = along / np.linalg.norm(along, axis=-1, keepdims=True)
        side = left[:, :, None] - (left[:, :, None] * along).sum(-1, keepdims=True) * along
        # An arm stretched out sideways has no left direction of its own.
        side = side / np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 0.2)
        offset = self.definition + self.profile.personal * personal
        moved = joints + offset[..., :1] * along + offset[..., 1:2] * side
        moved = moved + offset[..., 2:] * np.cross(along, side)
        outward = np.array([1.0, -1.0])[:, None] * left[:, :, None]
        hips = self.profile.wide_hips * outward
        hips[..., 2] -= self.profile.low_hips
        moved[:, :, 11:13] += hips
        return np.asarray(moved)


@dataclass(frozen=True, eq=False)
class Filming:
    """A detector before one camera's images, at a frame rate [1/s]; `rng` draws its errors."""

    detector: Detector
    view: ForeignView
    image_size: Integers
    fps: float
    rng: np.random.Generator

    @property
    def profile(self) -> DetectorProfile:
        """Rates and spreads."""
        return self.detector.profile

    def detect(self, defined: Floats, lost: float) -> Report:
        """Return the detections of the detector's joints (frames, persons, 17, 2) [px].

        `lost` is the share of frames that the camera lost.
        """
        profile, view, rng = self.profile, self.view, self.rng
        frames, persons = view.size.shape
        size = np.nan_to_num(view.size, nan=1.0)
        spread = profile.noise * size * (size / 100.0) ** -0.3
        spread = np.hypot(spread, profile.floor)[..., None] * _EASE
        hidden = (view.hider >= 0) | view.behind_self
        error = self._draw_errors(frames, persons) * spread[..., None]
        error *= np.where(hidden, 2.0, 1.0)[..., None]
        known = np.linalg.norm(error, axis=-1) / size[..., None]
        error = error + self._bias(size)
        keypoints = defined + error
        keypoints, strayed = self._misplace_joints(keypoints)
        keypoints = self._swap_sides(keypoints)
        if profile.grid > 0.0:
            cell = profile.grid * size[..., None, None]
            keypoints = np.round(keypoints / cell) * cell

        luck = rng.random((frames, persons, 17))
        shown = np.where(hidden, luck < profile.hidden_kept, luck > profile.joint_missed)
        there = view.inside & shown & np.isfinite(keypoints).all(axis=-1)
        found = rng.random(persons) < 1.0 / (1.0 + (profile.smallest / np.maximum(size, 1.0)) ** 6)
        found &= ~self._draw_bursts(profile.person_missed, 0.25, (frames, persons))
        found &= (view.hider >= 0).mean(axis=-1) < 0.75
        self._merge_people(keypoints, there, found)
        found &= there.sum(axis=-1) >= 4
        if lost > 0.0:
            found &= ~self._draw_bursts(lost, 0.1, (frames, 1))
        confidence = self._draw_confidence(known, hidden)
        false, sure = self._draw_false_positives(size)
        doubles = found & (rng.random(found.shape) < profile.duplicates)
        again = keypoints + 0.5 * spread[..., None] * rng.standard_normal(keypoints.shape)
        keypoints = np.concatenate([keypoints, again, false], axis=1)
        confidence = np.concatenate([confidence, 0.8 * confidence, sure], axis=1)
        shown = np.isfinite(false[..., 0])
        there = np.concatenate([there, there, shown], axis=1)
        found = np.concatenate([found, doubles, shown.any(-1)], axis=1)
        whose = np.concatenate([*2 * [np.arange(persons)], np.full(false.shape[1], -1)])
        displaced = np.concatenate([strayed, strayed, np.zeros_like(shown)], axis=1)
        there &= found[..., None]
        keypoints = np.where(there[..., None], keypoints, np.nan)
        confidence = np.where(there, np.clip(confidence, 0.01, 1.0), np.nan)

        def box(order: Integers, places: Floats, found: Flags) -> Floats:
            low = np.where(np.isfinite(places), places, np.inf).min(axis=2, initial=np.inf)
            high = np.where(np.isfinite(places), places, -np.inf).max(axis=2, initial=-np.inf)
            tall = np.where(found[..., None], high - low, 0.0)
            room = rng.uniform(0.02, 0.12, (*found.shape, 2)) * tall + 1.0
            return np.concatenate([low - room, high + room], axis=-1)

        return list_detections(keypoints, confidence, displaced & there, whose, box, rng)

    def _draw_errors(self, frames: int, persons: int) -> Floats:
        """Return unit errors (frames, persons, 17, 2): resonant, sudden, and shared along limbs."""
        from scipy.signal import (
            lfilter,  # late: it takes a second, and lists of scenarios need none
        )

        profile, rng, shape = self.profile, self.rng, (persons, 17, 2)
        lead = round(2.0 * self.fps)
        driven = rng.standard_normal((frames + lead, *shape))
        swinging = np.empty(driven.shape)
        for joint in range(17):
            period = rng.uniform(*profile.resonance)
            decay = np.exp(-1.0 / (0.7 * period * self.fps))
            turn = 2.0 * np.pi / max(period * self.fps, 4.0)
            poles = [1.0, -2.0 * decay * np.cos(turn), decay**2]
            swinging[:, :, joint] = lfilter([1.0], poles, driven[:, :, joint], axis=0)
        swinging = swinging[lead:] / swinging[lead:].std(axis=(0, 1, 3), keepdims=True)
        jumps = np.clip(rng.standard_t(profile.tail, (frames, *shape)), -15.0, 15.0)
        jumps /= np.sqrt(profile.tail / (profile.tail - 2.0))
        own = np.sqrt(1.0 - profile.sudden) * swinging + np.sqrt(profile.sudden) * jumps
        for joint in (7, 8, 9, 10, 13, 14, 15, 16):
            mixed = profile.limbs * own[:, :, _PARENT[joint]] + own[:, :, joint]
            own[:, :, joint] = mixed / np.hypot(1.0, profile.limbs)
        return np.asarray(own)

    def _bias(self, size: Floats) -> Floats:
        """Return the bias (frames, persons, 17, 2) [px] by azimuth and elevation of the camera."""
        azimuth = self.view.azimuth
        waves = [np.cos(azimuth), np.sin(azimuth), np.cos(3.0 * azimuth), np.sin(3.0 * azimuth)]
        bias = np.einsum("fpw,jaw->fpja", np.stack(waves, axis=-1), self.detector.view_bias)
        bias[..., 1] += np.sin(self.view.elevation)[..., None] * self.detector.height_bias
        return np.asarray(bias * size[..., None, None])

    def _misplace_joints(self, keypoints: Floats) -> tuple[Floats, Flags]:
        """Return keypoints with gross errors in bursts, and their flags."""
        view, rng, shape = self.view, self.rng, keypoints.shape[:3]
        away = self._draw_bursts(self.profile.strayed, 0.12, shape)
        # A joint behind another person more often gets that person's position.
        away |= (view.hider >= 0) & self._draw_bursts(6.0 * self.profile.strayed, 0.15, shape)
        frame, person, joint = np.nonzero(away)
        kind = rng.integers(3, size=len(frame))
        hider = view.hider[frame, person, joint]
        kind = np.where((hider >= 0) & (rng.random(len(frame)) < 0.7), 3, kind)
        parents, others = np.array(_PARENT), np.array(COCO17_FLIP)
        share = rng.uniform(0.3, 0.9, len(frame))[:, None]
        here = keypoints[frame, person, joint]
        parent = keypoints[frame, person, parents[joint]]
        angle = rng.uniform(0.0, 2.0 * np.pi, len(frame))
        throw = 0.25 * view.size[frame, person] * rng.uniform(0.3, 1.0, len(frame))
        targets = [
            keypoints[frame, person, others[joint]],
            share * parent + (1.0 - share) * here,
            here + throw[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1),
            keypoints[frame, np.maximum(hider, 0), joint],
        ]
        moved = keypoints.copy()
        moved[frame, person, joint] = np.choose(kind[:, None], targets)
        return moved, away

    def _swap_sides(self, keypoints: Floats) -> Floats:
        """Return keypoints with left-right swaps of parts in bursts, more often from behind."""
        swapped, shape = keypoints.copy(), self.view.size.shape
        for part in (slice(1, 5), slice(5, 11), slice(11, 17), slice(0, 17)):
            on = self._draw_bursts(0.5 * self.profile.swapped, 0.2, shape)
            more = self._draw_bursts(self.profile.swapped, 0.2, shape)
            on |= more & (np.cos(self.view.azimuth) < 0.0)
            swapped[on, part] = keypoints[on][:, COCO17_FLIP[part]]
        return swapped

    def _merge_people(self, keypoints: Floats, there: Flags, found: Flags) -> None:
        """Merge two people who overlap, in place: half of the joints of each."""
        merging = self._draw_bursts(self.profile.merged, 0.3, found.shape)
        crowded = (self.view.hider >= 0).mean(axis=-1) > 0.4
        for frame, person in np.argwhere(merging & crowded & found):
            hiders = self.view.hider[frame, person]
            before = int(np.bincount(hiders[hiders >= 0]).argmax())
            if not found[frame, before]:
                continue
            half = slice(0, 11) if self.rng.random() < 0.5 else slice(11, 17)
            keypoints[frame, before, half] = keypoints[frame, person, half]
            there[frame, before, half] = there[frame, person, half]
            found[frame, person] = False

    def _draw_confidence(self, known: Floats, hidden: Flags) -> Floats:
        """Return confidence (frames, persons, 17); biases, gross errors and swaps keep it."""
        luck, kind = self.rng.standard_normal(known.shape), self.profile.confidence
        honest = 1.0 / (1.0 + (known / 0.06) ** 2) * np.where(hidden, 0.6, 1.0) + 0.06 * luck
        if kind == "honest":
            return np.asarray(honest)
        if kind == "meek":
            return np.asarray(0.1 + 0.35 * np.clip(honest, 0.0, 1.0))
        if kind == "sure":
            return np.asarray(np.minimum(0.96 + 0.02 * luck, 1.0) - 0.05 * hidden)
        return np.asarray(self.rng.beta(4.0, 2.0, known.shape))

    def _draw_false_positives(self, size: Floats) -> tuple[Floats, Floats]:
        """Return keypoints (frames, false, 17, 2) of false positives, and their confidence."""
        rng, frames, usual = self.rng, len(size), float(np.median(size))
        ghosts = int(rng.poisson(self.profile.ghosts))
        flashes = rng.poisson(self.profile.flashes, frames)
        count = ghosts + int(flashes.max(initial=0))
        places = np.full((frames, count, 17, 2), np.nan)

        def figure(rows: int) -> Floats:
            tall = usual * rng.lognormal(0.0, 0.35)
            middle = rng.uniform(0.05, 0.9, 2) * self.image_size
            warped = _STICKMAN * rng.uniform(0.6, 1.4, (17, 2)) * tall + middle
            return np.asarray(warped + 0.02 * tall * rng.standard_normal((rows, 17, 2)))

        for ghost in range(ghosts):
            shown = rng.random(frames) < rng.uniform(0.3, 0.95)
            places[:, ghost] = np.where(shown[:, None, None], figure(frames), np.nan)
        for frame in np.flatnonzero(flashes):
            for flash in range(flashes[frame]):
                places[frame, ghosts + flash] = figure(1)[0]
        outside = ((places < 0.0) | (places > self.image_size - 1.0)).any(axis=-1)
        places[outside] = np.nan
        return places, rng.uniform(0.15, 0.8, places.shape[:3])

    def _draw_bursts(self, share: float, length: float, shape: tuple[int, ...]) -> Flags:
        """Return flags set for a share of the first dimension, in bursts of a mean duration [s]."""
        stop = min(1.0, 1.0 / max(length * self.fps, 1.0))
        begin = min(1.0, stop * share / max(1.0 - share, 1e-9))
        luck = self.rng.random(shape)
        on = np.empty(shape, np.bool_)
        on[0] = luck[0] < share
        for row in range(1, shape[0]):
            on[row] = np.where(on[row - 1], luck[row] >= stop, luck[row] < begin)
        return on
