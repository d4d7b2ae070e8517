"""The subjects of a data set, and the shape of each by the static cameras of its clips."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from data_contracts import release as contracts
from data_contracts.arrays import Floats
from flows.results import best_results
from flows.results.best_results import Origin
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.dataset.subjects import SubjectFit
from worldpose.formats.archives import wrong
from worldpose.formats.files import read_yaml


def name_subjects(
    clips: Mapping[str, contracts.ReleasedSequence], file: Path | None
) -> dict[str, contracts.ReleasedSequence]:
    """Return the clips with the subjects of a registry."""
    registry = {} if file is None else read_yaml(file)
    known = {person for clip in clips.values() for person in clip.subjects}
    owner: dict[str, str] = {}
    for subject, people in registry.items() if isinstance(registry, dict) else [("", None)]:
        for person in people if isinstance(people, list) else [people]:
            if person not in known or person in owner:
                expected = "a list of MATCH/NAME or MATCH/CLIP/ID of the data set, each once"
                todo = f"Known are {', '.join(sorted(known)[:8])}, ..."
                raise wrong(f"{file}: {subject}", expected, f"{person!r}", todo)
            owner[person] = str(subject)
    named = {}
    for name, clip in clips.items():
        subjects = tuple(owner.get(person, person) for person in clip.subjects)
        named[name] = clip.model_copy(update={"subjects": subjects})
    return named


def subject_fits(
    label: str, subjects: Sequence[str], origin: Origin, clip: str
) -> Iterator[SubjectFit]:
    """Yield a clip's shapes by its static cameras, without other clips, in the order of subjects.

    People whom only the broadcast camera films have no betas.
    """
    run, unit = origin.run, f"body_fitting/{clip}"
    bodies = run[best_results.bodies_unit(run, clip)]
    weight = 0.0
    found: dict[object, tuple[Floats, Floats]] = {}
    if unit in run:
        # Other settings of an older run may be none of today's.
        settings = run.record.settings["body_fitting"]
        stated: object = settings.get("shape_weight", BodyFittingSettings().shape_weight)
        if not isinstance(stated, int | float) or stated < 0.0:
            where = f"run {run.record.run_id}: settings of body_fitting: shape_weight"
            raise wrong(where, "a number", f"{stated!r}", "Run the match again.")
        weight = 0.0 if settings.get("method") == "paper" else float(stated)
        arrays = (run[unit][each].values for each in ("person", "betas", "betas_covariance"))
        found = {person: (betas, spread) for person, betas, spread in zip(*arrays, strict=True)}
    model = str(bodies.attrs["body_model"])
    people = bodies["person"].values, bodies["betas"].values, subjects
    for person, best, subject in zip(*people, strict=True):
        betas, spread = found.get(person, (np.full(1, np.nan), np.empty(0)))
        is_known = bool(np.isfinite(betas).all() and np.isfinite(spread).all())
        shape = Shape(betas, spread) if is_known else Shape(np.empty(0), np.empty((0, 0)))
        is_best = is_known and np.array_equal(betas, best)
        yield SubjectFit(subject, model, label, shape, weight, is_best)
