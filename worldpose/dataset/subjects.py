"""subjects.npz: the shape of every person of a data set, from all clips and matches together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_contracts.release import Finding, ReleasedSequence
from worldpose.body_fitting.bones import Shape, agree, pool_shapes
from worldpose.errors import InputError
from worldpose.formats.archives import Member, read_archive, write_archive, wrong
from worldpose.formats.joints_file import read_poses


class SubjectFit(NamedTuple):
    """The shape of one subject in one clip, without betas if static cameras do not film them.

    `prior_weight` is as for `pool_shapes`: 0 if the covariance is a placeholder.
    """

    subject: str
    body_model: str
    clip: str
    shape: Shape
    prior_weight: float
    in_poses: bool = False
    """Whether the clip's poses have these betas: they are from the first fits."""


def pool_subjects(
    fits: Iterable[SubjectFit],
) -> dict[tuple[str, str], tuple[list[SubjectFit], Shape | None]]:
    """Return the fits and the shape of every subject and body model.

    Betas mean another body in each body file: a person who was fitted with several, such as neutral
    and female, has a shape of each. There is none if two clips' bodies cannot be one person's.
    """
    groups: dict[tuple[str, str], list[SubjectFit]] = {}
    for fit in (each for each in fits if len(each.shape.betas)):
        groups.setdefault((fit.subject, fit.body_model), []).append(fit)
    pooled: dict[tuple[str, str], tuple[list[SubjectFit], Shape | None]] = {}
    for key, own in sorted(groups.items()):
        shapes = [fit.shape for fit in own]
        pairs = list(combinations([fit.shape for fit in own if fit.prior_weight > 0.0], 2))
        # Divided by their number, the level is that of all comparisons together.
        same = all(agree(*pair, level=0.001 / len(pairs)) for pair in pairs)
        weights = [fit.prior_weight for fit in own]
        pooled[key] = own, pool_shapes(shapes, weights) if same else None
    return pooled


def write_subjects(path: Path, fits: Iterable[SubjectFit]) -> None:
    """Write pooled shapes, in rows without a clip, and each clip's own; NaN where there is none."""
    fits = sorted(fits, key=lambda fit: fit[:2])
    pooled, unknown = pool_subjects(fits), Shape(np.empty(0), np.empty((0, 0)))
    rows = [SubjectFit(*key, "", one or unknown, np.nan) for key, (_, one) in pooled.items()]
    rows += fits
    most = max((len(row.shape.betas) for row in rows), default=0)
    betas = np.full((len(rows), most), np.nan)
    covariance = np.full((len(rows), most, most), np.nan)
    for n, shape in enumerate(row.shape for row in rows):
        betas[n, : len(shape.betas)] = shape.betas
        covariance[n, : len(shape.betas), : len(shape.betas)] = shape.covariance
    subjects, models, clips, _, weights, direct = zip(*rows, strict=True) if rows else [()] * 6
    names = {"subjects": subjects, "body_models": models, "clips": clips}
    arrays = {key: np.array(values, dtype=np.str_) for key, values in names.items()}
    numbers = {"betas": betas, "covariance": covariance, "prior_weights": np.array(weights, float)}
    numbers["in_poses"] = np.array(direct, dtype=np.int8)
    write_archive(path, {**arrays, **numbers})


def read_subjects(path: Path) -> list[SubjectFit]:
    """Read the rows of subjects.npz: first pooled ones, without a clip, then those of clips."""
    members = dict.fromkeys(("subjects", "body_models", "clips"), Member(("rows",), "text"))
    members["betas"] = Member(("rows", "shapes"), "float")
    members["covariance"] = Member(("rows", "shapes", "shapes"), "float")
    members["prior_weights"] = Member(("rows",), "float")
    members["in_poses"] = Member(("rows",), "int")
    found = read_archive(path, members)
    names = (found[key].tolist() for key in ("subjects", "body_models", "clips"))
    shapes = []
    for betas, covariance in zip(found["betas"], found["covariance"], strict=True):
        count = int(np.isfinite(betas).sum())
        shapes.append(Shape(betas[:count], covariance[:count, :count]))
        if not all(np.isfinite(each).all() for each in vars(shapes[-1]).values()):
            raise wrong(f"{path}: betas, covariance", "numbers, then NaN to the end", "a gap")
    numbers = (found["prior_weights"].tolist(), found["in_poses"].astype(np.bool_).tolist())
    return [*map(SubjectFit, *names, shapes, *numbers)]


def subject_findings(part: Path, clips: Mapping[str, ReleasedSequence]) -> Iterator[Finding]:
    """Yield pooled shapes that clips do not give, and clips' bodies that are no one person's."""
    where = f"{next(iter(clips.values())).split}/subjects.npz"
    try:
        rows = read_subjects(part / "subjects.npz")
        pooled = pool_subjects(row for row in rows if row.clip)
    except (InputError, ValueError, np.linalg.LinAlgError) as error:
        yield Finding(fault="unreadable", kind="damage", where=(where,), says=str(error))
        return
    stated = {(row.subject, row.body_model): row.shape for row in rows if not row.clip}
    known = ((one, clip.body_model, name) for name, clip in clips.items() for one in clip.subjects)
    own_rows = Counter(row[:3] for row in rows if row.clip)
    if own_rows != Counter(known) or stated.keys() != pooled.keys():
        says = "subjects, body models and clips are not those of release.json"
        yield Finding(fault="subjects_differ", kind="damage", where=(where,), says=says)
    for key, (own, shape) in pooled.items():
        right = np.empty(0) if shape is None else np.vstack([shape.betas, shape.covariance])
        told = stated.get(key, own[0].shape)
        found = np.vstack([told.betas, told.covariance]) if len(told.betas) else np.empty(0)
        if found.shape != right.shape or not np.allclose(found, right):
            says = "the pooled shape is not that of the clips' bodies"
            yield Finding(fault="shape_differs", kind="damage", where=(key[0], where), says=says)
        if shape is None:
            says = f"bodies of {', '.join(fit.clip for fit in own)} cannot be one person's"
            where_to = key[0], where
            yield Finding(fault="subject_shapes", kind="plausibility", where=where_to, says=says)
    for name, clip in clips.items():
        for subject in _other_bodies(part / "poses" / f"{name}.npz", name, clip, rows):
            says = f"the shape in {name} is not that of the poses"
            yield Finding(fault="shape_differs", kind="damage", where=(subject, where), says=says)


def _other_bodies(
    path: Path, name: str, clip: ReleasedSequence, rows: Sequence[SubjectFit]
) -> Iterator[str]:
    """Yield subjects whose rows of first fits have other betas than the clip's poses."""
    try:
        betas = read_poses(path)[0].betas
    except InputError:  # the check of the clip tells it
        return
    betas = betas[:, 0] if betas.ndim == 3 else betas
    own: dict[str, list[SubjectFit]] = {}
    for row in reversed([row for row in rows if row.clip == name]):
        own.setdefault(row.subject, []).append(row)
    # A subject may have several people of one clip, in the same order in both files.
    for subject, place in zip(clip.subjects, betas, strict=False):
        if not own.get(subject) or not (row := own[subject].pop()).in_poses:
            continue
        found = row.shape.betas
        if found.shape != place.shape or not np.allclose(found, place, rtol=0.0, atol=1e-5):
            yield subject
