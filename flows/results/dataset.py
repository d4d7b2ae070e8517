"""Validation of an exported data set, clip by clip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.release import CheckReport, DataSetStatistics, Finding
from worldpose.body.body_file import OPEN_BODY, find_body
from worldpose.body.model import BodyModel
from worldpose.dataset.check import check_clip
from worldpose.dataset.contents import camera_files, list_clips, read_clip
from worldpose.dataset.manifest import changed_files, read_manifest, stated_rate
from worldpose.dataset.statistics import (
    camera_kind,
    clip_statistics,
    data_set_statistics,
    most_moving,
    read_places,
)
from worldpose.errors import UsageError

USUAL_FPS = 50.0
"""Frames per second if neither an export nor a person states it: that of the released clips."""


def stated_rates(folder: Path, fps: float | None = None) -> dict[str, float | None]:
    """Return the frames per second of each clip of a data set; None where it is not stated."""
    return {clip: fps or stated_rate(folder, clip) for clip in list_clips(folder)}


def check(
    folder: Path,
    *,
    fps: float | None = None,
    body: str | None = None,
    pitch: bool = True,
    only: str | None = None,
    models: Mapping[str, BodyModel] = MappingProxyType({}),
) -> CheckReport:
    """Check a data set and return faults and measurements; one clip is in memory at a time.

    The folder is one of `worldpose export`, or of the same layout. Without `fps` the rate is the
    one that the data set states, or 50 per second; `body` is the model of pose files that name
    none, and `models` has bodies, by name, that may not be installed. `pitch` says whether the
    ground is z = 0; a manifest can state otherwise. `only` is the clip to check; None = all.
    InputError if a file cannot be read.
    """
    manifest = read_manifest(folder)
    findings, notes = list[Finding](), list[str]()
    if manifest is not None and (changed := changed_files(folder, manifest.files)):
        findings.append(
            Finding(
                fault="changed_files",
                kind="damage",
                where=tuple(changed),
                says=f"files of release {manifest.release} are gone or have other bytes",
            )
        )
    rates = stated_rates(folder, fps)
    clips = tuple(rates)
    figures = {}
    for name, rate in rates.items():
        if only not in (None, name):
            continue

        def find(model: str | None, clip: str = name) -> BodyModel:
            if model is None and body is None:
                notes.append(
                    f"poses of {clip} name no body model: {OPEN_BODY} is assumed (--body); shapes "
                    "of another one have no meaning"
                )
            return models.get(model or "") or find_body(model or body or OPEN_BODY)

        shipped = read_clip(
            folder,
            name,
            clips,
            find,
            manifest,
            rate or USUAL_FPS,
            pitch and (manifest is None or manifest.pitch),
        )
        figures[name], found = check_clip(shipped)
        findings += found
        notes.extend(shipped.notes)
    return CheckReport(clips=figures, findings=tuple(findings), notes=tuple(notes))


def count(folders: Sequence[Path], *, fps: float | None = None) -> DataSetStatistics:
    """Count the content of one data set, which can span several folders.

    One clip is in memory at a time. Without `fps` the rate is the one that the data sets state, or
    50 per second. UsageError if two folders have the same name and clips.
    """
    clips = {}
    for folder in folders:
        rates = stated_rates(folder, fps)
        for name, views in _views_of_clips(folder, tuple(rates)).items():
            files = [camera_files(folder, view, rates) for view, _ in views]
            kind = most_moving(camera_kind(each) for own, _ in files for each in own)
            if all(not own and static for own, static in files):
                kind = "S"
            label = name if len(folders) == 1 else f"{folder.resolve().name}/{name}"
            if label in clips:
                raise UsageError(
                    str(folder),
                    expected="folders of different names",
                    found=f"{label} twice",
                    todo="Name each folder once, or rename one of them.",
                )
            places = np.concatenate([own for _, own in views], axis=1)
            clips[label] = clip_statistics(places, rates[views[0][0]] or USUAL_FPS, kind)
    return data_set_statistics(clips)


def _views_of_clips(folder: Path, names: tuple[str, ...]) -> dict[str, list[tuple[str, Floats]]]:
    """Return the views of each clip, with the places of the people whom no earlier view has.

    A submission has an entry `<clip>.<camera>` for each of several broadcast cameras of a clip:
    some of their people are at the same places in the same frames.
    """
    views: dict[str, list[tuple[str, Floats]]] = {}
    for name in names:
        places, clip = read_places(folder, name), name.rpartition(".")[0]
        known = {one.tobytes() for _, seen in views.get(clip, ()) for one in seen.swapaxes(0, 1)}
        columns = places.swapaxes(0, 1)  # empty columns are alike, but nobody
        new = np.array([c.tobytes() not in known or np.isnan(c).all() for c in columns], np.bool_)
        own = clip if clip and (clip not in views or not new.all()) else name
        views.setdefault(own, []).append((name, places[:, new]))
    return {own if len(seen) > 1 else seen[0][0]: seen for own, seen in views.items()}
