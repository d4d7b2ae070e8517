"""Checking an exported data set, clip by clip."""

from __future__ import annotations

from pathlib import Path

from data_contracts.release import CheckReport, Finding
from worldpose.body import OPEN_BODY, find_body
from worldpose.dataset.check import check_clip
from worldpose.dataset.manifest import changed_files, frame_rate_of, read_frame_rates, read_manifest
from worldpose.dataset.reading import clips_in, read_clip
from worldpose.dataset.settings import CheckSettings

USUAL_FPS = 50.0
"""Frames in a second where neither an export nor a person says it: the released clips'."""


def stated_rates(folder: Path, fps: float | None = None) -> dict[str, float | None]:
    """Frames in a second of a data set's clips; None where neither it nor a person says it.

    Raises:
        InputError: a file cannot be read.
    """
    clips, manifest = clips_in(folder), read_manifest(folder)
    said = fps or (None if manifest is None else manifest.fps)
    rates = read_frame_rates(folder)
    return {clip: said or frame_rate_of(rates, clip) for clip in clips}


def check(
    folder: Path,
    *,
    fps: float | None = None,
    body: str | None = None,
    pitch: bool = True,
    settings: CheckSettings | None = None,
) -> CheckReport:
    """What is wrong with a data set, and what was measured; one clip is in memory at a time.

    Args:
        folder: what `worldpose export` wrote, or another of the same layout.
        fps: frames in a second; None = what the data set says, or 50.
        body: body model of pose files that name none; None = the open body.
        pitch: whether the ground is z = 0; a manifest may say that it is not.
        settings: what counts as wrong.

    Raises:
        InputError: a file cannot be read.
    """
    settings = settings or CheckSettings()
    manifest = read_manifest(folder)
    findings = []
    if manifest is not None and (changed := changed_files(folder, manifest)):
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
        shipped = read_clip(
            folder,
            name,
            clips,
            lambda model: find_body(model or body or OPEN_BODY),
            manifest,
            rate or USUAL_FPS,
            pitch and (manifest is None or manifest.pitch),
        )
        figures[name], found = check_clip(shipped, settings)
        findings += found
    return CheckReport(clips=figures, findings=tuple(findings))
