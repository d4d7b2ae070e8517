"""Who is the same person in a data set, and the shape of each by the clips' static cameras."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from data_contracts import release as contracts
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
    """Yield the shapes of a clip's people by its static cameras, without those of other clips."""
    run, unit = origin.run, f"body_fitting/{clip}"
    if unit not in run:
        return
    settings = BodyFittingSettings.model_validate(run.record.settings["body_fitting"])
    rows = run[best_results.bodies_unit(run, clip)]["person"].values.tolist()
    subject_of = dict(zip(rows, subjects, strict=True))
    arrays = (run[unit][each].values for each in ("person", "betas", "betas_covariance"))
    for person, *shape in zip(*arrays, strict=True):
        if (who := subject_of.get(person)) and np.isfinite(shape[0]).all():
            model = str(run[unit].attrs["body_model"])
            yield SubjectFit(who, model, label, Shape(*shape), settings.prior_weight)
