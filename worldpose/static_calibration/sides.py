"""Sides of the pitch on which cameras stand, decided by people in view of several cameras.

The pitch looks the same after half a turn, so that the paint in one image does not tell from which
side it was taken. People do: under the right choice, feet in two images meet on the ground. One
stated side then decides all cameras.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.match import Side
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate

MIN_EVIDENCE: Final = 7.0
"""Minimum log probability ratio that decides a side [1]: a thousand to one."""
INDEPENDENT_S: Final = 1.0
"""Time after which people stand elsewhere [s]: frames closer together count together as one."""
_CELL_M: Final = 2.0
"""Cells in which the shared view is measured [m]."""


@dataclass(frozen=True, eq=False)
class SeenPeople:
    """People in one camera's images, placed by their feet with the camera on its assumed side.

    Attributes:
        camera: the camera; None = people of the whole pitch, by cameras with known sides.
        xy: (frames, people, 2) places [m], world; NaN where there is no person.
        noise: (frames, people, 2, 2) their covariance [m^2].
    """

    camera: Camera | None
    xy: Floats
    noise: Floats


@dataclass(frozen=True)
class SideDecision:
    """Whether a camera stands where it is assumed to, or half a turn about the centre spot away.

    Attributes:
        turned: whether it has to be turned; None = the people do not tell.
        evidence: log probability ratio of the least sure step of the decision [1].
        contradicted: whether people contradict the stated side.
        partners: cameras that see the same people, the surest first; those against it if
            contradicted.
    """

    turned: bool | None
    evidence: float
    contradicted: bool
    partners: tuple[str, ...]

    def require_side(self, where: str) -> bool:
        """Return whether the camera has to be turned.

        InputError if people do not tell the side, or contradict the stated one.
        """
        if self.contradicted:
            raise InputError(
                where,
                expected="people at the places where the other cameras see them",
                found=f"agreement with {', '.join(self.partners[:3])} only after half a turn about "
                "the centre spot: the stated side is wrong, or theirs",
                todo="State the opposite side in match.yaml, or take `side` out of this camera.",
            )
        if self.turned is None:
            raise InputError(
                where,
                expected="people that both this camera and one with a known side detect",
                found=f"no agreement that decides between two sides (evidence below "
                f"{MIN_EVIDENCE:g})"
                + (f"; it agrees with {', '.join(self.partners[:3])}" if self.partners else ""),
                todo="State the camera's side (near, far, left, right) in match.yaml.",
            )
        return self.turned


def turn_camera(camera: Camera) -> Camera:
    """Return a camera after half a turn about the vertical axis through the centre spot."""
    pose = camera.cam_from_world
    half = np.array([-1.0, -1.0, 1.0])
    return replace(camera, cam_from_world=Rigid(pose.rotation * half, pose.translation))


def place_at(side: Side) -> Floats:
    """Return a place (3,) [m], world, far out on a side of the pitch."""
    axis, meters = {"near": (1, -99), "far": (1, 99), "left": (0, -99), "right": (0, 99)}[side]
    return np.asarray(meters * np.eye(3)[axis])


def turn_name(name: str) -> str:
    """Return the name of the marking that lies half a turn about the centre spot away."""
    other = {"left": "right", "right": "left", "near": "far", "far": "near"}
    return "_".join(other.get(word, word) for word in name.split("_"))


def tells_side(name: str) -> bool:
    """Return whether a point or marking is another one after half a turn, or has an own name."""
    return turn_name(name) != name or name not in ("center_mark", "center_circle", "halfway_line")


def decide_sides(
    seen: Mapping[str, SeenPeople], stated: Collection[str], pitch: PitchTemplate, seconds: Floats
) -> dict[str, SideDecision]:
    """Return for every camera whether it has to be turned by half a turn.

    Groups of cameras with known relative sides are joined, the surest two first. Those joined to a
    camera whose side is stated are decided. All have people at the same times (frames,) [s].
    """
    names = tuple(seen)
    views = [_SideView(seen[name], _seen_cells(seen[name].camera, pitch)) for name in names]
    evidence = np.zeros((len(names), len(names)))
    for a in range(len(names)):
        for b in range(a + 1, len(names)):
            same, turned = _compare(views[a], views[b], pitch, seconds)
            evidence[a, b] = evidence[b, a] = same - turned
    anchored = [k for k, name in enumerate(names) if name in stated]
    wrong = _find_contradicted(evidence, anchored)
    trusted = [k for k in anchored if k not in wrong]
    groups = [trusted or anchored, *([k] for k in range(len(names)) if k not in anchored)]
    groups, sign, surety = _join(evidence, groups)
    decided = {}
    for k, name in enumerate(names):
        support = evidence[k] * sign[k] * sign
        others = [j for j in np.argsort(-support, kind="stable") if support[j] > 0.0]
        against = [j for j in np.argsort(support, kind="stable") if support[j] < 0.0]
        decided[name] = SideDecision(
            turned=bool(sign[k] < 0.0) if k in groups[0] or k in anchored else None,
            evidence=float(surety[k]),
            contradicted=k in wrong,
            partners=tuple(names[j] for j in (against if k in wrong else others)),
        )
    return decided


def _find_contradicted(evidence: Floats, anchored: list[int]) -> set[int]:
    """Return the cameras whose stated side fewer others share than the opposite one.

    Of two cameras that contradict each other, either may be wrong: both are.
    """
    groups, sign, _ = _join(evidence, [[k] for k in anchored])
    wrong: set[int] = set()
    for group in groups:
        for side in (1.0, -1.0):
            own = [k for k in group if sign[k] == side]
            if 2 * len(own) <= len(group):
                wrong |= set(own)
    return wrong


def _join(evidence: Floats, groups: list[list[int]]) -> tuple[list[list[int]], Floats, Floats]:
    """Join groups of cameras whose relative side the evidence decides, the surest two first.

    Return groups; signs (n,), -1 of a camera that is turned against the first of its group; and the
    evidence (n,) of the least sure join that decides the camera.
    """
    groups, count = [list(each) for each in groups], len(evidence)
    sign, surety = np.ones(count), np.full(count, np.inf)
    while True:
        best, pair = MIN_EVIDENCE, (0, 0)
        for a in range(len(groups)):
            for b in range(a + 1, len(groups)):
                total = abs(float(_between(evidence, sign, groups[a], groups[b]).sum()))
                if total >= best:
                    best, pair = total, (a, b)
        if pair == (0, 0):
            return groups, sign, np.where(np.isfinite(surety), surety, 0.0)
        first, second = (groups[k] for k in pair)
        sign[second] *= np.sign(_between(evidence, sign, first, second).sum())
        surety[[*first, *second]] = np.minimum(surety[[*first, *second]], best)
        groups[pair[0]] = [*first, *second]
        del groups[pair[1]]


def _between(evidence: Floats, sign: Floats, first: list[int], second: list[int]) -> Floats:
    """Return the evidence (a, b) between two groups of cameras, as they stand now."""
    return np.asarray(evidence[np.ix_(first, second)] * sign[first][:, None] * sign[second])


def compare_sides(
    first: SeenPeople, second: SeenPeople, pitch: PitchTemplate, seconds: Floats
) -> tuple[float, float]:
    """Return how well people agree if two cameras stand as assumed, and with one of them turned.

    Each is the log probability ratio to people who have nothing to do with each other, under the
    likeliest share of people that both cameras detect; it is 0 or more, since people that only one
    camera found decide nothing. Both cameras have the same times (frames,) [s].
    """
    views = (_SideView(each, _seen_cells(each.camera, pitch)) for each in (first, second))
    return _compare(next(views), next(views), pitch, seconds)


class _SideView(NamedTuple):
    """People of one camera, and which cells of the pitch it sees, row by row."""

    people: SeenPeople
    cells: Flags

    def turn(self) -> _SideView:
        """Return the view after half a turn: covariances stay, and cells come in reverse."""
        camera = self.people.camera
        turned = None if camera is None else turn_camera(camera)
        people = replace(self.people, camera=turned, xy=-self.people.xy)
        return _SideView(people, self.cells[::-1])


def _compare(
    first: _SideView, second: _SideView, pitch: PitchTemplate, seconds: Floats
) -> tuple[float, float]:
    """Return what `compare_sides` returns."""
    frames = max(1, len(seconds))
    moments = 1.0 + (float(np.ptp(seconds)) / INDEPENDENT_S if len(seconds) else 0.0)
    weight = 0.5 * min(1.0, moments / frames)
    found = []
    for other in (second, second.turn()):
        area = _CELL_M**2 * float(np.count_nonzero(first.cells & other.cells))
        found.append(
            weight
            * (
                _agreement(first.people, other.people, pitch, area)
                + _agreement(other.people, first.people, pitch, area)
            )
        )
    return found[0], found[1]


def _seen_cells(camera: Camera | None, pitch: PitchTemplate) -> Flags:
    """Return which cells of the pitch a camera sees (cells,)."""
    limits = (0.5 * pitch.length, 0.5 * pitch.width)
    counts = (max(1, round(2.0 * limit / _CELL_M)) for limit in limits)
    x, y = (
        np.linspace(-limit, limit, 2 * count + 1)[1::2]
        for limit, count in zip(limits, counts, strict=True)
    )
    return _sees(camera, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), pitch)


def _agreement(own: SeenPeople, other: SeenPeople, pitch: PitchTemplate, area: float) -> float:
    """Return the log probability ratio of one camera's people, given those of the other."""
    # Shares of people that the other camera found; the likeliest counts.
    shares = np.array([0.3, 0.6, 0.9])
    if area < 50.0:
        return 0.0
    density: list[Floats] = []
    (xy, noise, frames), (other_xy, other_noise, other_frames) = (
        _people_in_both(a, b, pitch) for a, b in ((own, other), (other, own))
    )
    for frame in np.unique(frames):
        here, there = frames == frame, other_frames == frame
        if not there.any():
            density.append(np.zeros(np.count_nonzero(here)))
            continue
        away = xy[here][:, None] - other_xy[there]
        spread = noise[here][:, None] + other_noise[there]
        # The error [m] of a proposed camera and its clock.
        spread = spread + 0.5**2 * np.eye(2)
        squared = (away * np.linalg.solve(spread, away[..., None])[..., 0]).sum(axis=-1)
        peak = 1.0 / (2.0 * np.pi * np.sqrt(np.linalg.det(spread)))
        density.append((peak * np.exp(-0.5 * squared)).mean(axis=1))
    if not density:
        return 0.0
    ratio = area * np.concatenate(density)
    scores = np.log1p(shares[:, None] * (ratio - 1.0)).sum(axis=1)
    return float(max(0.0, scores.max()))


def _people_in_both(
    own: SeenPeople, other: SeenPeople, pitch: PitchTemplate
) -> tuple[Floats, Floats, Integers]:
    """Return places, covariances and frames of people on the pitch that the other should detect."""
    # Benches behind both touch lines are as alike as the lines.
    limits = np.array([0.5 * pitch.length, 0.5 * pitch.width]) + 0.5
    known = np.isfinite(own.xy[..., 0])
    frame, _ = np.nonzero(known)
    xy = own.xy[known]
    kept = (np.abs(xy) <= limits).all(axis=1) & _sees(other.camera, xy, pitch)
    return xy[kept], own.noise[known][kept], frame[kept]


def _sees(camera: Camera | None, xy: Floats, pitch: PitchTemplate) -> Flags:
    """Return whether places (n, 2) [m] on the pitch are in a camera's image (n,)."""
    if camera is None:
        return np.ones(len(xy), np.bool_)
    ground = np.concatenate([xy, pitch.height(xy[:, 0], xy[:, 1])[:, None]], axis=1)
    pixels = camera.project(ground)
    # People may be cut off at the border.
    margin = 0.01 * float(camera.image_size[0])
    with np.errstate(invalid="ignore"):
        inside = (pixels >= margin) & (pixels <= camera.image_size - 1.0 - margin)
    return np.asarray(inside.all(axis=1))
