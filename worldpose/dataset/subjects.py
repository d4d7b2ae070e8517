"""subjects.npz: the shape of every person of a data set, from all clips and matches together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_contracts.release import Finding, ReleasedSequence
from worldpose.body_fitting.bones import Shape, agree, pool_shapes
from worldpose.errors import InputError
from worldpose.formats.archives import Member, read_archive, write_archive


class SubjectFit(NamedTuple):
    """The shape of one subject in one clip; `prior_weight` is as for `pool_shapes`."""

    subject: str
    body_model: str
    clip: str
    shape: Shape
    prior_weight: float


def pool_subjects(
    fits: Iterable[SubjectFit],
) -> dict[tuple[str, str], tuple[list[SubjectFit], Shape | None]]:
    """Return the fits and the shape of every subject and body model.

    Betas mean another body in each body file: a person who was fitted with several, such as neutral
    and female, has a shape of each. There is none if two clips' bodies cannot be one person's.
    """
    groups: dict[tuple[str, str], list[SubjectFit]] = {}
    for fit in fits:
        groups.setdefault((fit.subject, fit.body_model), []).append(fit)
    pooled: dict[tuple[str, str], tuple[list[SubjectFit], Shape | None]] = {}
    for key, own in sorted(groups.items()):
        shapes = [fit.shape for fit in own]
        same = all(agree(*pair) for pair in combinations(shapes, 2))
        weights = [fit.prior_weight for fit in own]
        pooled[key] = own, pool_shapes(shapes, weights) if same else None
    return pooled


def write_subjects(path: Path, fits: Iterable[SubjectFit]) -> None:
    """Write pooled shapes, in rows without a clip, and each clip's own; NaN where there is none."""
    pooled, unknown = pool_subjects(fits), Shape(np.empty(0), np.empty((0, 0)))
    rows = [SubjectFit(*key, "", one or unknown, np.nan) for key, (_, one) in pooled.items()]
    rows += [fit for own, _ in pooled.values() for fit in own]
    most = max((len(row.shape.betas) for row in rows), default=0)
    betas = np.full((len(rows), most), np.nan)
    covariance = np.full((len(rows), most, most), np.nan)
    for n, (*_, shape, _) in enumerate(rows):
        betas[n, : len(shape.betas)] = shape.betas
        covariance[n, : len(shape.betas), : len(shape.betas)] = shape.covariance
    subjects, models, clips, _, weights = zip(*rows, strict=True) if rows else [()] * 5
    names = {"subjects": subjects, "body_models": models, "clips": clips}
    arrays = {key: np.array(values, dtype=np.str_) for key, values in names.items()}
    numbers = {"betas": betas, "covariance": covariance, "prior_weights": np.array(weights, float)}
    write_archive(path, {**arrays, **numbers})


def read_subjects(path: Path) -> list[SubjectFit]:
    """Read the rows of subjects.npz: first pooled ones, without a clip, then those of clips.

    Raises:
        InputError: the file is absent or damaged.
    """
    members = dict.fromkeys(("subjects", "body_models", "clips"), Member(("rows",), "text"))
    members["betas"] = Member(("rows", "shapes"), "float")
    members["covariance"] = Member(("rows", "shapes", "shapes"), "float")
    members["prior_weights"] = Member(("rows",), "float")
    found = read_archive(path, members)
    names = (found[key].tolist() for key in ("subjects", "body_models", "clips"))
    shapes = []
    for betas, covariance in zip(found["betas"], found["covariance"], strict=True):
        count = int(np.isfinite(betas).sum())
        shapes.append(Shape(betas[:count], covariance[:count, :count]))
    return [*map(SubjectFit, *names, shapes, found["prior_weights"].tolist())]


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
    known = {(one, clip.body_model, name) for name, clip in clips.items() for one in clip.subjects}
    if not {row[:3] for row in rows if row.clip} <= known or stated.keys() != pooled.keys():
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
