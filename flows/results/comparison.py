"""Comparison of two runs of a match by metrics: cameras, clips and players better or worse.

Only metrics where lower is better are compared, and none that needs ground truth. A metric is
better or worse if it changed by more than 1 % and by more than its minimum relevant change. A
camera, clip or player is better if some of its metrics are better and none is worse, worse in the
opposite case, mixed if both occur, else unchanged.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.run import BODY_STAGES, RunRecord
from flows.registering import find_registration
from flows.results.best_results import bodies_unit
from flows.results.run_cameras import static_cameras
from worldpose.geometry.cameras import Camera
from worldpose.store.store import Run, Store

Kind = Literal["match", "clip", "camera", "player"]
Mark = Literal["better", "worse", "mixed", "unchanged", "only in A", "only in B"]

KINDS: Final[tuple[Kind, ...]] = ("match", "clip", "camera", "player")
MIN_RELATIVE_CHANGE: Final = 0.01
"""Minimum relative change of a metric [1]."""
MIN_CHANGES: Final[Mapping[str, Mapping[str, float]]] = {
    "static_calibration": {"expected_ground_error_median_m": 1e-3, "clicks_wrong": 0.0},
    "tracking": {"mean_ray_distance_m": 1e-3, "unmatched_share": 1e-3, "undecided": 0.0},
    "bundle_adjustment": {"held_out_error_after_px": 0.01},
    "retriangulation": {"standard_deviation_m": 1e-4, "filled_share": 1e-3, "misplacement_m": 1e-3},
    "bodies": {
        "offset_rms_m": 1e-4,
        "residual_m": 1e-4,
        "reprojection_px": 0.01,
        "skating_m": 1e-4,
    },
    "broadcast_calibration": {"expected_error_median_px": 0.01},
    "filtering": {"held_out_error": 1e-4, "rejected_share": 1e-3},
}
"""Stage, metric, and its minimum relevant change, in its unit; `bodies` are those of the last
fit. A tenth of a millimetre and a hundredth of a pixel are below the resolution of a joint's
standard deviation of 30 mm; shares are of thousands of keypoints."""

Figures = dict[str, float]
Subject = tuple[Kind, str]


@dataclass(frozen=True)
class Change:
    """One metric, as `stage/unit metric`, in two runs."""

    figure: str
    before: float
    after: float
    mark: Mark


@dataclass(frozen=True)
class SubjectChange:
    """Metrics of one camera, clip, player or the match in two runs.

    The name of a player is like `clip: person 3`; `figures` are the metrics that both runs have.
    """

    kind: Kind
    name: str
    mark: Mark
    figures: tuple[Change, ...]


def compare_runs(
    store: Store, a: RunRecord, b: RunRecord, paired: Mapping[tuple[str, str], str] | None = None
) -> list[SubjectChange]:
    """Compare the match, its clips, cameras and players in B with A.

    Players are paired by position, whatever their ids; a player in only one run is marked so.
    `paired` are their pairs, if they are known.
    """
    before = _subjects(a, {})
    after = _subjects(b, paired_people(store, a, b) if paired is None else paired)
    return [
        _change(subject, before.get(subject), after.get(subject))
        for subject in sorted(before.keys() | after.keys(), key=_order)
    ]


def count_marks(changes: list[SubjectChange], kind: Kind) -> dict[Mark, int]:
    """Return the number of subjects of a kind by mark."""
    return dict(Counter(change.mark for change in changes if change.kind == kind))


def _change(subject: Subject, before: Figures | None, after: Figures | None) -> SubjectChange:
    kind, name = subject
    if before is None or after is None:
        return SubjectChange(kind, name, "only in B" if before is None else "only in A", ())
    figures = tuple(
        Change(figure, before[figure], after[figure], _mark(figure, before[figure], after[figure]))
        for figure in sorted(before.keys() & after.keys())
    )
    marks = {change.mark for change in figures} - {"unchanged"}
    over_all: Mark = "mixed" if len(marks) > 1 else next(iter(marks), "unchanged")
    return SubjectChange(kind, name, over_all, figures)


def _mark(figure: str, before: float, after: float) -> Mark:
    stage = figure.partition("/")[0]
    least = max(MIN_RELATIVE_CHANGE * abs(before), MIN_CHANGES[stage][figure.rpartition(" ")[2]])
    if abs(after - before) <= least:
        return "unchanged"
    return "better" if after < before else "worse"


def _subjects(record: RunRecord, names: Mapping[tuple[str, str], str]) -> dict[Subject, Figures]:
    """Return the metrics of every subject of a run, of bodies those of the last fit.

    `names` are players' names in the other run.
    """
    found: dict[Subject, Figures] = {}
    last = BODY_STAGES[-1]
    for unit, figures in record.figures.items():
        stage, _, place = unit.partition("/")
        if stage in BODY_STAGES:
            if stage != last and f"{last}/{place}" in record.figures:
                continue
            stage, unit = "bodies", f"bodies/{place}"
        for name, value in figures.items():
            figure, _, part = name.partition(".")
            if figure in MIN_CHANGES.get(stage, {}):
                subject = _subject(stage, place, part, names)
                found.setdefault(subject, {})[f"{unit} {figure}"] = value
    return found


def _subject(stage: str, unit: str, part: str, names: Mapping[tuple[str, str], str]) -> Subject:
    if stage == "static_calibration":
        return "camera", unit
    if stage == "bundle_adjustment":
        return "match", unit
    if not part:
        return "clip", unit
    if stage == "bodies":
        name = names.get((unit, part), part).replace("person", "person ")
        return "player", f"{unit}: {name}"
    return "camera", part


def _order(subject: Subject) -> tuple[int, list[str | int]]:
    """Return a sort key: kinds in order, names in natural order."""
    kind, name = subject
    parts = re.split(r"(\d+)", name)
    return KINDS.index(kind), [int(part) if part.isdigit() else part for part in parts]


COMPARED_FRAMES: Final = 50
"""Compared frames, spread over the clip, so that people who are close only briefly differ."""
MAX_DISTANCE_M: Final = 1.0
"""Maximum mean joint distance of one person [m]: no two people stay closer for long."""


def paired_people(store: Store, a: RunRecord, b: RunRecord) -> dict[tuple[str, str], str]:
    """Map clip and `person<id>` of B to the name in A, for people whose name in A differs.

    A person of B without a match in A is named `person<id> of B`.
    """
    names = {}
    for bodies in bodies_of_both(Run(store, a), Run(store, b)):
        pairs = bodies.pairs()
        for place, person in enumerate(bodies.person_after.tolist()):
            known = pairs.get(place)
            name = f"person{person} of B"
            if known is not None:
                name = f"person{bodies.person_before[known]}"
            if name != f"person{person}":
                names[bodies.clip, f"person{person}"] = name
    return names


@dataclass(frozen=True, eq=False)
class BodiesOfBoth:
    """Bodies of one clip in two runs, in their common frames.

    Attributes:
        frame: (frames,) match frames.
        person_before: (persons,) ids in A; person_after: (others,) ids in B.
        before: (frames, persons, 17, 3) [m], world, of A; after: (frames, others, 17, 3), of B.
    """

    clip: str
    frame: NDArray[np.integer]
    person_before: NDArray[np.integer]
    person_after: NDArray[np.integer]
    before: Floats
    after: Floats

    def pairs(self) -> dict[int, int]:
        """Map person indices of B to those of A, for matched people."""
        step = max(len(self.frame) // COMPARED_FRAMES, 1)
        return pair_people(self.before[::step], self.after[::step])


def bodies_of_both(a: Run, b: Run) -> Iterator[BodiesOfBoth]:
    """Yield the clips whose bodies differ between two runs."""
    clips = {unit.partition("/")[2] for unit in a if unit.partition("/")[0] in BODY_STAGES}
    for clip in sorted(clips):
        one, other = bodies_unit(a, clip), bodies_unit(b, clip)
        if other not in b or a.record.results[one] == b.record.results[other]:
            continue
        frames = np.intersect1d(a[one]["frame"].values, b[other]["frame"].values)
        before, after = (found.sel(frame=frames) for found in (a[one], b[other]))
        yield BodiesOfBoth(
            clip,
            frames,
            before["person"].values,
            after["person"].values,
            before["joints"].values,
            after["joints"].values,
        )


def pair_people(before: Floats, after: Floats) -> dict[int, int]:
    """Map indices of `after` to those of `before`, for mutual nearest neighbours.

    Both are (frames, persons, joints, 3) [m], in the same frames.
    """
    if not before.shape[1] or not after.shape[1]:
        return {}
    away = np.linalg.norm(before[:, :, None] - after[:, None], axis=-1)
    known = np.isfinite(away)
    count = known.sum(axis=(0, 3))
    total = np.where(known, away, 0.0).sum(axis=(0, 3))
    mean = np.divide(total, count, out=np.full(count.shape, np.inf), where=count > 0)
    nearest = mean.argmin(axis=0)
    return {
        other: int(person)
        for other, person in enumerate(nearest)
        if mean[person].argmin() == other and mean[person, other] <= MAX_DISTANCE_M
    }


MIN_JOINTS: Final = 9
"""Minimum number of a person's joints, of 17, inside the image."""


@dataclass(frozen=True)
class PoseChange:
    """Largest pose change in one camera's image.

    `person` is the id in the first run, `moved_px` the mean distance between its joints in the two
    runs [px].
    """

    clip: str
    camera: str
    frame: int
    person: int
    moved_px: float


def largest_pose_changes(store: Store, a: RunRecord, b: RunRecord) -> list[PoseChange]:
    """Return the five images with the largest pose changes, one per camera and clip, in order.

    Each run's bodies are projected with its own cameras.
    """
    spec = find_registration(store, a.match_id).spec
    ours, theirs = Run(store, a), Run(store, b)
    before, after = static_cameras(ours, spec), static_cameras(theirs, spec)
    found = []
    for bodies in bodies_of_both(ours, theirs):
        for name in sorted(before.keys() & after.keys()):
            found += _worst(bodies, name, before, after)
    return sorted(found, key=lambda picture: -picture.moved_px)[:5]


def _worst(
    bodies: BodiesOfBoth, name: str, before: Mapping[str, Camera], after: Mapping[str, Camera]
) -> list[PoseChange]:
    """Return a camera's image with the largest change; empty if no person of both runs is in it."""
    pairs = bodies.pairs()
    if not pairs or not len(bodies.frame):
        return []
    people = list(pairs.values())
    one = before[name].project(bodies.before[:, people])
    other = after[name].project(bodies.after[:, list(pairs)])
    away = np.linalg.norm(one - other, axis=-1)
    inside = ((one >= 0) & (one < before[name].image_size)).all(axis=-1) & np.isfinite(away)
    joints = inside.sum(axis=-1)
    mean = np.where(inside, away, 0.0).sum(axis=-1) / np.maximum(joints, 1)
    mean[joints < MIN_JOINTS] = -1.0
    frame, place = np.unravel_index(int(mean.argmax()), mean.shape)
    if mean[frame, place] < 0:
        return []
    return [
        PoseChange(
            bodies.clip,
            name,
            int(bodies.frame[frame]),
            int(bodies.person_before[people[place]]),
            float(mean[frame, place]),
        )
    ]
