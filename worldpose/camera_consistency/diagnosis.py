"""Cameras that are inconsistent with the others, and the most probable fault of each."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats
from data_contracts.camera_consistency import FaultKind
from worldpose.camera_consistency.comparison import Comparison, Trial, chance_noise
from worldpose.camera_consistency.hypotheses import (
    STATED,
    Hypothesis,
    lens_hypotheses,
    pose_hypotheses,
    rotate_camera,
)
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera

MIN_GAIN: Final[dict[FaultKind, float]] = {
    "flipped": 1.5,
    "mirrored": 1.5,
    "pose": 1.5,
    "swapped": 1.5,
    "focal": 1.15,
    "lens": 1.05,
    "clock": 1.15,
    "frame_rate": 1.15,
}
"""Minimum ratio of matches with and without the correction. Lens orders have no free parameter."""
FINE: Final = ("focal", "lens", "clock", "frame_rate")
"""Faults that may be small."""


@dataclass(frozen=True)
class Fault:
    """A camera that is inconsistent with the others.

    Attributes:
        kind: the most probable fault.
        detail: description; may be empty.
        value: ratio or frames, if the fault has one.
        other: index of the other camera of a swap, duplicate or contradiction.
        cause: cause of a contradiction, the fault of this camera that would explain it.
        source: index of the other camera of a swap that would explain a contradiction.
        share_now: share of its detections that agree with others as stated [1].
        share_corrected: the same after correction of the fault; None without a known correction.
    """

    camera: int
    kind: FaultKind
    detail: str = ""
    value: float | None = None
    other: int | None = None
    cause: FaultKind | None = None
    source: int | None = None
    share_now: float = 0.0
    share_corrected: float | None = None


@dataclass(frozen=True)
class Consistency:
    """Result of the consistency check.

    Attributes:
        faults: inconsistent cameras, the clearest first.
        confirmed: cameras in agreement with others.
        unconfirmed: cameras without people in common with others, which cannot be checked.
        agreement: (cameras, cameras) matches of two cameras above chance [persons per frame].
        strangers: cameras whose people fit those of no other camera, if these are most cameras:
            then none of them is diagnosed.
    """

    faults: tuple[Fault, ...]
    confirmed: tuple[int, ...]
    unconfirmed: tuple[int, ...]
    agreement: Floats
    strangers: tuple[int, ...] = ()


class Diagnosis:
    """Iterative diagnosis: removes the camera with the clearest fault until none is left."""

    def __init__(
        self, comparison: Comparison, fps: float, given: Flags, tilt: Floats, focal_error: Floats
    ) -> None:
        self.comparison = comparison
        self.fps = fps
        self.given, self.tilt, self.focal_error = given, tilt, focal_error
        count = comparison.count
        self.agreement, self.deviation = np.zeros((count, count)), np.ones((count, count))
        pairs = list(itertools.combinations(range(count), 2))
        agreements = map_in_threads(lambda pair: comparison.agreement(pair[0], pair[1]), pairs)
        for (a, b), (found, deviation) in zip(pairs, agreements, strict=True):
            self.agreement[a, b] = self.agreement[b, a] = found
            self.deviation[a, b] = self.deviation[b, a] = deviation
        self.faults: list[Fault] = []

    def run(self) -> Consistency:
        """Return the faults, and the confirmed and unconfirmed cameras."""
        count = self.comparison.count
        self.find_duplicates()
        core = self.core([c for c in range(count) if c not in self.faulty])
        if not core:
            self.record_contradiction()
        for c in [c for c in range(count) if c not in core and c not in self.faulty and core]:
            found = self.explain(c, core, gross=True)
            if found is not None:
                self.blame(c, found[0], core)
                # Its group shows other people, unless the correction brings it to the core.
                share = self.faults[-1].share_corrected
                least = 0.5 if self.has_partner(c) else 0.2
                if (share is None and self.has_partner(c)) or (share is not None and share < least):
                    self.faults.pop()
        self.complete_swaps(core)
        for c in [c for c in range(count) if c not in core and c not in self.faulty and core]:
            self.record_unexplained(c, core)
        self.peel(core)
        return Consistency(
            tuple(self.faults),
            tuple(c for c in core if c not in self.faulty),
            tuple(c for c in range(count) if c not in core and c not in self.faulty),
            self.agreement,
        )

    @property
    def faulty(self) -> set[int]:
        """Cameras with a fault."""
        return {fault.camera for fault in self.faults}

    def has_partner(self, c: int) -> bool:
        """Return whether a camera agrees with another one."""
        return bool((self.agreement[c] > 4.0 * self.deviation[c]).any())

    def core(self, among: Sequence[int]) -> list[int]:
        """Return the connected group of cameras with the most agreement; empty if no two agree."""
        edges = self.agreement > 4.0 * self.deviation
        left, best, most = set(among), list[int](), 0.0
        while left:
            group, queue = list[int](), [left.pop()]
            while queue:
                c = queue.pop()
                group.append(c)
                reached = left & {int(each) for each in np.flatnonzero(edges[c])}
                left -= reached
                queue += sorted(reached)
            weight = float(np.where(edges, self.agreement, 0.0)[np.ix_(group, group)].sum())
            if weight > most:
                best, most = sorted(group), weight
        return best

    def peel(self, core: list[int]) -> None:
        """Find faults among cameras in partial agreement, the clearest first."""
        seen = self.comparison.people_seen
        share = self.agreement / np.maximum(1.0, np.minimum(seen[:, None], seen))
        suspects = list(core)

        def examine(c: int) -> tuple[float, int, Trial] | None:
            partners = [p for p in core if p != c and p not in self.faulty]
            gross = bool(share[c].max() < 0.5)
            if gross:  # partners that agree with it by chance would not test it
                support = {p: sum(share[p, q] for q in partners) for p in partners}
                partners.sort(key=lambda p: -support[p])
            else:
                partners.sort(key=lambda p: -self.agreement[c, p])
            most = 6 if gross else 4
            trials = self.explain(c, partners[:most], gross)
            return trials and (trials[0].matches - trials[1].matches, c, trials[0])

        while suspects:
            found = [each for each in map_in_threads(examine, suspects) if each is not None]
            if not found:
                return
            _, worst, trial = max(found, key=lambda each: each[0])
            self.blame(worst, trial, [p for p in core if p not in self.faulty])
            suspects = [c for _, c, _ in found if c != worst]

    def blame(self, c: int, trial: Trial, core: Sequence[int]) -> None:
        """Record a fault shown by the cameras of `core`.

        Shown by one camera, or by no more than those that agree with it, it is a contradiction.
        """
        others = [p for p in core if p != c]
        people = self.comparison.people(others) if len(others) > 1 else None
        hypothesis = trial.hypothesis
        kind, source = hypothesis.kind, hypothesis.source
        found = Fault(c, kind, hypothesis.detail, hypothesis.value, source)
        if people is not None:
            now, corrected = (
                self.comparison.shares(c, each, people)[0] for each in (STATED, hypothesis)
            )
            found = replace(found, share_now=now, share_corrected=corrected)
        own = int((self.agreement[c] > 4.0 * self.deviation[c]).sum()) + 1
        alone = len(others) == 1 and kind != "swapped"
        if alone or (c not in core and own >= len(others) > 1):
            found = replace(found, kind="contradiction", other=others[0], cause=kind, source=source)
        self.faults.append(found)

    # -- faults of cameras that agree with no others -----------------------------------------

    def find_duplicates(self) -> None:
        """Record cameras with the same video: the one with less agreement with others is wrong."""
        count = self.comparison.count
        support = np.where(self.agreement > 4.0 * self.deviation, self.agreement, 0.0).sum(axis=1)
        for a in range(count):
            for b in range(a + 1, count):
                if self.faulty & {a, b} or not self.comparison.same_video(a, b):
                    continue
                wrong, right = (a, b) if support[a] < support[b] else (b, a)
                self.faults.append(Fault(wrong, "duplicate", other=right))

    def complete_swaps(self, core: Sequence[int]) -> None:
        """Record the other camera of each swap, unless others confirm it."""
        for fault in list(self.faults):
            other = fault.other
            if fault.kind == "swapped" and other not in {None, *core, *self.faulty}:
                self.faults.append(replace(fault, camera=int(other or 0), other=fault.camera))

    def record_contradiction(self) -> None:
        """Record the single fault whose correction makes cameras agree, if no two of them do."""
        comparison = self.comparison
        judged = [c for c in range(comparison.count) if c not in self.faulty]
        left = [
            c
            for c in judged
            if any(p != c and not comparison.is_side_by_side(c, p) for p in judged)
        ]
        best: tuple[float, int, Trial] | None = None
        for c in left:
            found = self.explain(c, [p for p in left if p != c], gross=True)
            if found is not None and (best is None or found[0].matches > best[0]):
                best = (found[0].matches, c, found[0])
        for a in left:
            for b in left:
                swapped = self.swap_videos(a, b) if a < b else None
                if swapped is not None and (best is None or swapped.matches > best[0]):
                    best = (swapped.matches, a, swapped)
        if best is None:
            return
        _, c, trial = best
        if trial.hypothesis.kind == "swapped" and trial.hypothesis.source is not None:
            self.faults.append(Fault(c, "swapped", other=trial.hypothesis.source))
            self.faults.append(Fault(trial.hypothesis.source, "swapped", other=c))
        elif trial.partners >= 2:
            self.blame(c, trial, left)
        else:
            self.blame(c, trial, [next(p for p in left if p != c)])

    def swap_videos(self, a: int, b: int) -> Trial | None:
        """Return the agreement of two cameras after a swap of their videos, or None."""
        comparison = self.comparison
        views = [
            comparison.view(c, Hypothesis("swapped", "", source=s)) for c, s in ((a, b), (b, a))
        ]
        there = comparison.held_out
        by_frame = comparison.scores(views[0], views[1], there, there)
        found = float(by_frame.mean())
        now = float(
            comparison.scores(comparison.views[a], comparison.views[b], there, there).mean()
        )
        if found < MIN_GAIN["swapped"] * now or found - now < 4.0 * chance_noise(now):
            return None
        return Trial(Hypothesis("swapped", "", source=b), found - now, now, 1, by_frame)

    def record_unexplained(self, c: int, core: Sequence[int]) -> None:
        """Record a camera that misses people seen by the others, without a known cause."""
        if self.has_partner(c) or len(core) < 3:
            return
        people = self.comparison.people(core)
        share, found, expected = self.comparison.shares(c, STATED, people)
        seen = np.isfinite(self.comparison.views[c].rays[..., 0]).any(axis=-1).sum()
        enough = len(self.comparison.sample)
        if min(expected, seen) >= enough and found < 0.2:
            self.faults.append(Fault(c, "pose", share_now=share))

    # -- one camera --------------------------------------------------------------------------

    def explain(self, c: int, partners: Sequence[int], gross: bool) -> tuple[Trial, Trial] | None:
        """Return the trial of a camera's best confirmed fault, and of the camera as stated.

        Every kind of fault is fitted to a third of the frames and tested on the others. Partners
        are assumed correct; if the camera agrees with none, `gross`, all kinds are tried.
        """
        if not partners:
            return None
        comparison = self.comparison
        quick = comparison.quick(c, STATED, partners)
        now: Trial | None = None
        best: Trial | None = None
        for value, hypothesis in self.proposals(c, partners, gross):
            need = MIN_GAIN[hypothesis.kind]
            if value < need * quick or value - quick < 0.2:
                continue
            if now is None:
                now = comparison.trial(c, self.polish(c, STATED, partners), partners)
            # The stated camera was rotated for the best fit; its small corrections get the same.
            fine = hypothesis.kind in FINE
            tried = self.polish(c, hypothesis, partners) if fine else hypothesis
            trial = comparison.trial(c, tried, partners)
            if trial.matches < need * now.matches or not self.certain(trial, now):
                continue
            if best is None or self.rank(trial) > self.rank(best):
                best = trial
        return None if best is None or now is None else (best, now)

    @staticmethod
    def certain(trial: Trial, now: Trial) -> bool:
        """Return whether a correction increases matches beyond chance.

        Consistent gains over frames prove a small change; several partners prove a large one.
        """
        min_certainty = 3.5  # [standard errors]
        if trial.hypothesis.kind in FINE and trial.certainty(now) > min_certainty:
            return True
        if trial.partners > now.partners and trial.certainty(now) > min_certainty:
            return True
        gain = trial.matches - now.matches
        return trial.partners >= now.partners + 2 and gain > 4.0 * chance_noise(trial.chance)

    @staticmethod
    def rank(trial: Trial) -> float:
        """Return the rank of an explanation: matches, reduced for kinds with more freedom."""
        # Kinds with more freedom count less.
        simpler = {"pose": 1.05, "focal": 1.02, "lens": 1.02, "frame_rate": 1.05}
        return trial.matches / simpler.get(trial.hypothesis.kind, 1.0)

    def polish(self, c: int, hypothesis: Hypothesis, partners: Sequence[int]) -> Hypothesis:
        """Return the hypothesis with the camera rotated, within its uncertainty, for the best fit.

        A small rotation of a camera resembles some faults of its lens.
        """
        camera = self.comparison.cameras[c] if hypothesis.camera is None else hypothesis.camera
        best, value = hypothesis, self.comparison.quick(c, hypothesis, partners)
        turn = np.zeros(3)
        for step in (0.5, 0.25, 0.125):
            for axis in (0, 1, 2, 0, 1):
                for sign in (-1.0, 1.0):
                    tried = turn.copy()
                    tried[axis] += sign * step * self.tilt[c]
                    if abs(tried[axis]) > self.tilt[c]:
                        continue
                    option = replace(hypothesis, camera=rotate_camera(camera, tried))
                    found = self.comparison.quick(c, option, partners)
                    if found > value:
                        best, value, turn = option, found, tried
                        break
        return best

    def proposals(
        self, c: int, partners: Sequence[int], gross: bool
    ) -> Iterator[tuple[float, Hypothesis]]:
        """Yield the best correction of each kind, with its matches in the fitting frames."""
        comparison, camera = self.comparison, self.comparison.cameras[c]

        def best(options: Iterable[Hypothesis]) -> Iterator[tuple[float, Hypothesis]]:
            tried = [(comparison.quick(c, each, partners), each) for each in options]
            yield from sorted(tried, key=lambda each: -each[0])[:1]

        if self.given[c]:
            yield from best(lens_hypotheses(camera))
        reach = 0.7 if gross else 0.35
        for _, coarse in best(focal_lengths(camera, 1.0, reach, round(reach / 0.05))):
            around = 1.0 / (coarse.value or 1.0)
            for value, fine in best(focal_lengths(camera, around, 0.04, 4)):
                if abs(math.log(fine.value or 1.0)) > self.focal_error[c]:
                    yield value, fine
        yield from self.clocks(c, partners, gross)
        if gross:
            poses = list(pose_hypotheses(camera))
            for kind in ("flipped", "mirrored", "pose"):
                yield from best(each for each in poses if each.kind == kind)
            others = (s for s in range(comparison.count) if s != c)
            yield from best(Hypothesis("swapped", "", source=s) for s in others)

    def clocks(
        self, c: int, partners: Sequence[int], gross: bool
    ) -> Iterator[tuple[float, Hypothesis]]:
        """Yield the best constant clock offset, and the best other frame rate."""
        comparison, search = self.comparison, self.comparison.search
        view = comparison.view(c, STATED, np.arange(comparison.frames))
        longest = comparison.frames - 1
        band = longest if gross else min(longest, round(0.5 * self.fps))
        shifts = np.arange(-band, band + 1)
        table = np.zeros((len(shifts), len(search)))
        for k, n in enumerate(search):
            frames = comparison.sample[n] + shifts
            at = np.where((frames >= 0) & (frames <= longest), frames, -1)
            for p in partners:
                there = np.full(len(shifts), n)
                table[:, k] += comparison.scores(view, comparison.views[p], at, there)
        moments = comparison.sample[search]
        rates = np.array((1.0, *(0.5, 2.0, 24 / 25, 25 / 24, 25 / 30, 30 / 25, 24 / 30, 30 / 24)))
        # Matches along lines of the table, for every rate and start.
        rows = shifts[:, None] + np.round((rates[:, None, None] - 1.0) * moments) + band
        rows = rows.astype(np.int64)
        inside = (rows >= 0) & (rows < len(shifts))
        along = table[rows.clip(0, len(shifts) - 1), np.arange(len(moments))]
        along = np.where(inside, along, 0.0).mean(axis=-1)
        shift = int(shifts[int(along[0].argmax())])
        # Triangulation estimates smaller offsets.
        if abs(shift) >= 2:
            yield float(along[0].max()), self.change_clock("clock", float(shift), shift, 1.0)
        row, column = np.unravel_index(int(along[1:].argmax()), along[1:].shape)
        rate = float(rates[1:][row])
        yield (
            float(along[1:].max()),
            self.change_clock("frame_rate", rate, int(shifts[column]), rate),
        )

    def change_clock(self, kind: FaultKind, value: float, start: int, rate: float) -> Hypothesis:
        """Return the hypothesis of another start and rate of a camera's clock."""
        frames = np.round(start + rate * self.comparison.sample).astype(np.int64)
        inside = (frames >= 0) & (frames < self.comparison.frames)
        return Hypothesis(kind, "", value=value, time=np.where(inside, frames, -1))


def focal_lengths(camera: Camera, around: float, reach: float, steps: int) -> Iterator[Hypothesis]:
    """Yield focal lengths around `around` times the stated one, in logarithmic steps."""
    for ratio in around * np.exp(np.linspace(-reach, reach, 2 * steps + 1)):
        scaled = replace(camera, focal=camera.focal * float(ratio))
        yield Hypothesis("focal", "", scaled, value=float(1.0 / ratio))
