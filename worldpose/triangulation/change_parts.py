"""Changes of cameras within a clip: clocks and views that step or drift, of all cameras together.

Residuals in a bin b of frames give normal equations (M_b, s_b) of the clocks [frame] and views of
all cameras, with the joints free to follow (`sum_equations`). The offsets are A_b x, of sizes x of
the parts of clocks and views and of constant errors of views; these minimise

    sum_b (A_b x)^T M_b (A_b x) - 2 (A_b x)^T (s_b + M_b A_b x_0),

with the present sizes x_0. A further part with columns a_b lowers the sum by g^T K^-1 g,

    g = sum_b a_b^T r_b,  K = sum_b a_b^T M_b a_b - P^T N^-1 P,  P = sum_b A_b^T M_b a_b,

with what is left, r_b, and the normal matrix N of all other parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, Literal, Self

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.triangulation.change_sums import UNKNOWNS, WIDTH, ChangeSums, Kind, Noise
from worldpose.triangulation.synchronization import PRIOR

MIN_SIZE: Final = {
    ("clock", "drift"): 0.4,
    ("clock", "step"): 0.6,
    ("view", "drift"): 1.0,
    ("view", "step"): 4.0,
}
"""Least size of a part: of a clock [frame], as a recorder loses whole frames, and the errors that
views share differ between the ends of a clip; of a view [px]."""
MAX_VIEW: Final = np.array([0.2, 0.2, 0.2, 0.1])
"""Most that a view moves: rotation [rad] and growth [1]. People who agree nowhere show more."""
MIN_GAIN: Final[dict[Kind, float]] = {"clock": 30.0, "view": 60.0}
"""Least decrease of the sum of squares by a drift or a step, in variances of the noise [1]; half of
it in the seconds around a step. People who walk to another place meet other errors of the
calibration, a slow change."""


@dataclass(frozen=True)
class Part:
    """A part of the clock or the view of a camera: its size times its share at a row."""

    camera: int
    shape: Literal["constant", "drift", "step"]
    row: int
    """Row of the first frame after a step."""
    size: tuple[float, ...]
    """Of a clock [frame]; of a view, the rotation [rad] and the logarithm of the focal length. It
    is that over the whole clip of a drift."""

    @property
    def kind(self) -> Kind:
        """What changes."""
        return "clock" if len(self.size) == 1 else "view"

    @property
    def place(self) -> tuple[int, Kind, str, int]:
        """All but the size."""
        return self.camera, self.kind, self.shape, self.row

    @property
    def name(self) -> tuple[int, Kind, str]:
        """All but the size and the row."""
        return self.place[:3]

    @property
    def unknowns(self) -> Integers:
        """The unknowns that change."""
        return WIDTH * self.camera + UNKNOWNS[self.kind]

    def is_usual(self, focal: float) -> bool:
        """Return whether the size matters and a camera of focal length [px] can change so."""
        least = MIN_SIZE.get((self.kind, self.shape), 0.0)
        if self.kind == "clock":
            return abs(self.size[0]) >= least
        # Roll and growth move what is seen 0.3 rad from the axis, the usual place.
        size = focal * np.linalg.norm(self.size * np.array([1.0, 1.0, 0.3, 0.3]))
        return bool(size >= least and (np.abs(self.size) < MAX_VIEW).all())

    def share(self, rows: Floats | Integers, frames: int) -> Floats:
        """Return the share (n,) at rows of a clip of some frames."""
        if self.shape == "drift":
            return np.asarray(rows / max(1.0, frames - 1.0))
        return np.asarray(rows >= self.row, dtype=np.float64)

    def knots(self, frames: int) -> tuple[int, ...]:
        """Return the rows between which the part is linear."""
        if self.shape == "drift":
            return (0, frames - 1)
        return (0, self.row - 1, self.row) if self.shape == "step" else (0,)


def fit_parts(
    sums: ChangeSums, parts: Sequence[Part], frames: int, kinds: Sequence[Kind]
) -> list[Part]:
    """Return the parts that all cameras show, with their sizes.

    Parts are added, the clearest first, and dropped where the others explain what they did.
    """
    sums, there = _restore(sums, parts, frames)
    if not there.any():  # a clip that is shorter than what a step leaves open
        return list(parts)
    sums = sums.select(there)
    fit = _prune(_Fit.of(sums, parts, frames))
    # A change is noise until all are fitted: several are added, and those that are clear stay.
    grown = fit
    for _ in range(4):
        further = grown.find_part(kinds)
        if further is None:
            break
        grown = _Fit.of(sums, [*grown.sized(), further], frames)
    grown = _prune(grown)
    known = {part.place for part in fit.parts}
    gains = [grown.gain_of(k) * (part.place not in known) for k, part in enumerate(grown.parts)]
    # What gains less than a fifth of the largest can be its curvature: it waits until that is taken
    # back.
    kept = [
        part
        for part, gain in zip(grown.sized(), gains, strict=True)
        if part.place in known or gain > 0.2 * max(gains)
    ]
    # Where several views jump at once, it was a person whom the tracker took for another.
    steps = [(p.camera, p.row) for p in kept if p.name[1:] == ("view", "step")]
    kept = [
        p
        for p in kept
        if p.place in known
        or p.name[1:] != ("view", "step")
        or not any(c != p.camera and abs(row - p.row) < 0.5 * sums.fps for c, row in steps)
    ]
    return _prune(_Fit.of(sums, kept, frames)).sized()


def _prune(fit: _Fit) -> _Fit:
    """Return the fit of the parts that are clear with each other."""
    while True:
        noise = fit.noise()
        clear = [fit.clearness(k, noise) for k in range(len(fit.parts))]
        weakest = int(np.argmin(clear))
        if clear[weakest] >= 1.0:
            return fit
        parts = fit.sized()
        parts.pop(weakest)
        fit = _Fit.of(fit.sums, parts, fit.frames)


def expected_step(sums: ChangeSums, part: Part, frames: int) -> int:
    """Return the row of a step that single rows, with the step taken back, show."""
    own, size = part.unknowns, np.array(part.size)
    held = np.einsum("i,bij,j->b", size, sums.matrix[:, own[:, None], own], size)
    if not (held > 0.0).any():
        return part.row
    share = sums.score[:, own] @ size / np.maximum(held, 1e-12)
    share += part.share(sums.rows, frames)
    off = share - (sums.rows >= sums.rows[:, None])
    off -= (off @ held)[:, None] / held.sum()
    cost = off**2 @ held
    noise = max(1.0, float(cost.min()) / max(1, len(held) - 2))
    chance = np.exp(-0.5 * (cost - cost.min()) / noise)
    chance /= chance.sum()
    row = float(chance @ sums.rows)
    std = float(np.sqrt(chance @ (sums.rows - row) ** 2))
    lost = max(0.0, part.size[0]) if part.kind == "clock" else 0.0
    # Lost frames have no image: any row among them is as good.
    return part.row if abs(row - part.row) <= max(1.0 + lost, std) else round(row)


def fit_sizes(sums: ChangeSums, parts: Sequence[Part], frames: int) -> list[Part]:
    """Return the parts with their sizes, fitted together."""
    restored, there = _restore(sums, parts, frames)
    return _Fit.of(restored.select(there), parts, frames).sized()


def on_common_clock(parts: Sequence[Part]) -> list[Part]:
    """Return the parts with constants of changing clocks alone, towards the usual clock.

    A common offset changes no residual: most clocks keep theirs.
    """
    changing = {p.camera for p in parts if p.kind == "clock" and p.shape != "constant"}
    common = np.median([part.size[0] for part in parts if part.shape == "constant"])
    return [
        replace(part, size=(part.size[0] - common if part.camera in changing else 0.0,))
        if part.shape == "constant"
        else part
        for part in parts
    ]


def is_settled(before: Sequence[Part], after: Sequence[Part]) -> bool:
    """Return whether parts stay the same, to a small part of a frame or of a pixel."""

    def is_near(one: Part, other: Part) -> bool:
        most = 0.02 if one.kind == "clock" else 5e-5
        return float(np.abs(np.subtract(one.size, other.size)).max()) < most

    same = [part.place for part in before] == [part.place for part in after]
    constant = all(part.shape == "constant" for part in after)
    return same and (constant or all(map(is_near, before, after)))


def find_sway(
    before: ChangeSums, after: ChangeSums, parts: Sequence[Part]
) -> tuple[int, bool] | None:
    """Return the camera whose view is another in each second, and whether it is useless.

    The sums are those before and after the correction of parts: one camera's knocks and sags are
    not its sway, but many of them are. Without this camera, the others agree.
    """
    if not len(before.rows):
        return None
    views = [part.camera for part in parts if part.kind == "view"]
    each = np.array([after.sway(c) for c in range(after.cameras)])
    camera = int(np.argmax(each[:, 1]))
    if views and (most := max(views, key=views.count)) and views.count(most) > 2:
        camera, after = most, before
    rest, (size, gain) = before.without_camera(camera), after.sway(camera)
    usual = max(1.0, *(rest.sway(c)[1] for c in range(before.cameras) if c != camera))
    if size < 1.2e-3 or gain < 8.0 * usual:
        return None
    return camera, bool(gain > 64.0 * usual)


def spreads(sums: ChangeSums, parts: Sequence[Part], frames: int) -> list[Floats]:
    """Return the standard deviations of the sizes of parts that are corrected in the sums."""
    if not parts:
        return []
    fit, noise = _Fit.of(sums, parts, frames), sums.noise()
    variance = np.diagonal(fit.covariance)
    return [
        np.sqrt(variance[fit.sizes_of(k)] * noise[part.kind, part.shape == "drift"][part.camera])
        for k, part in enumerate(parts)
    ]


def _restore(sums: ChangeSums, parts: Sequence[Part], frames: int) -> tuple[ChangeSums, Flags]:
    """Return the sums of cameras that are not corrected, and which bins no step covers."""
    late, there = np.zeros_like(sums.score), np.ones(len(sums.rows), np.bool_)
    for part in parts:
        share = part.share(sums.rows, frames)
        late[:, part.unknowns] += share[:, None] * np.array(part.size)
        if part.shape == "step":  # its place is known to some frames; lost frames have no image
            lost = max(0.0, part.size[0]) if part.kind == "clock" else 0.0
            there &= np.abs(sums.rows - part.row) > 0.2 * sums.fps + lost
    return replace(sums, score=sums.score + (sums.matrix @ late[..., None])[..., 0]), there


@dataclass(frozen=True, eq=False)
class _Fit:
    """Parts, fitted to sums: the module's equations.

    Attributes:
        frames: of the clip.
        columns: (bins, unknowns, sizes + views), A.
        sizes: (sizes + views,), x.
        covariance: of the sizes, N^-1.
        left: (bins, unknowns), r.
        gain: decrease of the sum of squares by the parts [1].
    """

    sums: ChangeSums
    parts: Sequence[Part]
    frames: int
    columns: Floats
    sizes: Floats
    covariance: Floats
    left: Floats
    gain: float

    @classmethod
    def of(cls, sums: ChangeSums, parts: Sequence[Part], frames: int) -> Self:
        """Fit the sizes of all parts together."""
        unknowns, width = sums.score.shape[1], sum(len(part.size) for part in parts)
        columns = np.zeros((len(sums.rows), unknowns, width + 4 * sums.cameras))
        known, prior, start = np.zeros(columns.shape[2]), np.zeros(columns.shape[2]), 0
        for part in parts:
            own = start + np.arange(len(part.size))
            columns[:, part.unknowns, own] = part.share(sums.rows, frames)[:, None]
            known[own], start = part.size, start + len(own)
            prior[own] = 1e-2 if part.kind == "clock" else 400.0  # 10 frames, 3 degrees
        views = np.flatnonzero(np.arange(unknowns) % WIDTH)
        columns[:, views, width + np.arange(len(views))] = 1.0
        prior[width:] = np.tile(PRIOR, sums.cameras)
        held = sums.matrix @ columns
        inverse = np.linalg.inv(np.einsum("buk,bul->kl", columns, held) + np.diag(prior))
        pull = np.einsum("buk,bu->k", columns, sums.score) + prior * known
        sizes = inverse @ pull
        left = sums.score - held @ sizes
        return cls(sums, parts, frames, columns, sizes, inverse, left, float(pull @ sizes))

    def sizes_of(self, k: int) -> slice:
        """Return where the sizes of a part are."""
        start = sum(len(part.size) for part in self.parts[:k])
        return slice(start, start + len(self.parts[k].size))

    def sized(self) -> list[Part]:
        """Return the parts with their sizes."""
        each = (self.sizes[self.sizes_of(k)].tolist() for k in range(len(self.parts)))
        return [replace(p, size=tuple(size)) for p, size in zip(self.parts, each, strict=True)]

    def gain_of(self, k: int) -> float:
        """Return the increase of the sum of squares without a part."""
        size, own = (
            self.sizes[self.sizes_of(k)],
            self.covariance[self.sizes_of(k), self.sizes_of(k)],
        )
        return float(size @ np.linalg.solve(own, size))

    def noise(self) -> Noise:
        """Return the noise of what is left."""
        return replace(self.sums, score=self.left).noise()

    def clearness(self, k: int, noise: Noise) -> float:
        """Return how far a part is beyond the noise, over the least that counts [1]."""
        part = self.sized()[k]
        if part.shape == "constant":
            return np.inf
        if not part.is_usual(self.sums.focal[part.camera]) or self._returns(part):
            return 0.0
        usual = noise[part.kind, part.shape == "drift"][part.camera]
        own = self.sizes_of(k)
        spread = MIN_GAIN[part.kind] * usual * self.covariance[own, own]
        if part.kind == "view" and part.shape == "drift":
            # People who walk through the view meet its constant errors one after the other.
            spread = spread + np.diag(4.0 / np.array(PRIOR))
        size = self.sizes[own]
        clear = float(size @ np.linalg.solve(spread, size))
        if part.shape == "drift":
            return clear
        late = self.columns[:, :, self.sizes_of(k)] @ np.array(part.size)
        alone = self.left + (self.sums.matrix @ late[..., None])[..., 0]
        jumps = replace(self.sums, score=alone).steps(part.camera, part.kind)
        after = min(int(np.searchsorted(self.sums.rows, part.row)), len(jumps) - 1)
        jump = float(np.nan_to_num(jumps[after]))
        return float(min(clear, jump / (0.5 * MIN_GAIN[part.kind] * usual)))

    def _returns(self, part: Part) -> bool:
        """Return whether another step takes a view back: it was a person who came and went."""
        if (part.kind, part.shape) != ("view", "step"):
            return False
        others = [each.size for each in self.sized() if each.name == part.name]
        rest = np.linalg.norm(np.array(others) + part.size, axis=1)
        return float(rest.min()) < 0.5 * float(np.linalg.norm(part.size))

    def find_part(self, kinds: Sequence[Kind]) -> Part | None:
        """Return the part that lowers the sum of squares most, in variances of the usual noise."""
        noise, best, most = self.noise(), None, 0.0
        for c, kind in product(range(self.sums.cameras), kinds):
            for part, gain in self._candidates(c, kind):
                clear = gain / float(np.median(noise[kind, part.shape == "drift"]))
                if clear > most and gain > MIN_GAIN[kind]:
                    best, most = part, clear
        return best

    def _candidates(self, camera: int, kind: Kind) -> list[tuple[Part, float]]:
        """Return a drift and the best steps of a camera, with their gains."""
        rows, own = self.sums.rows, Part(camera, "step", 0, (0.0,) * len(UNKNOWNS[kind]))
        length = np.diff(rows).min() if len(rows) > 1 else 1.0
        jumps = replace(self.sums, score=self.left).steps(camera, kind)
        others = [part.row for part in self.parts if part.name == own.name]
        far = np.abs(rows[:, None] - np.array([*others, np.inf])).min(axis=1) > self.sums.fps
        inner = np.flatnonzero(np.isfinite(jumps) & far)
        starts = np.ceil(rows[inner] - 0.5 * length).astype(int)
        parts = [replace(own, shape="drift"), *(replace(own, row=int(row)) for row in starts)]
        gains = self._gains(parts)
        chosen = [0]
        if len(inner):
            chosen += {1 + int(np.argmax(gains[1:])), 1 + int(np.argmax(jumps[inner]))}
        return [(parts[k], float(gains[k])) for k in chosen]

    def _gains(self, candidates: Sequence[Part]) -> Floats:
        """Return the gains (n,) of further parts of one kind and camera."""
        own = candidates[0].unknowns
        follow = self.columns.swapaxes(1, 2) @ self.sums.matrix[:, :, own]
        shares = np.stack([part.share(self.sums.rows, self.frames) for part in candidates])
        held = self.sums.matrix[:, own[:, None], own]
        total = np.tensordot(shares**2, held, axes=1)
        fixed = np.tensordot(shares, follow, axes=1)
        stays = total - fixed.swapaxes(1, 2) @ self.covariance @ fixed
        # What the others explain as well, a part cannot tell.
        stays += 1e-3 * total * np.eye(len(own)) + 1e-9 * np.eye(len(own))
        force = shares @ self.left[:, own]
        sizes = np.linalg.solve(stays, force[..., None])[..., 0]
        return np.asarray((force * sizes).sum(axis=1))
