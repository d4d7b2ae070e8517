"""Whether a data set explains itself: what is wrong with it, by name, and the figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from data_contracts.records import Record
from worldpose.release.camera_rows import CameraRows
from worldpose.release.check_faults import Fault, camera_faults, point_faults
from worldpose.release.check_plausibility import (
    body_findings,
    camera_findings,
    ground_findings,
    plausible_share,
    world_fault,
)
from worldpose.release.check_reprojection import (
    SOUND,
    Agreement,
    agreement,
    agreement_findings,
    view_share,
)
from worldpose.release.check_settings import CheckSettings
from worldpose.release.shipped import Finding, PointSource, ShippedClip, View

_Sight = tuple[Fault, CameraRows, NDArray[np.float64]]


class ClipFigures(Record):
    """What was measured in one clip."""

    frames: int
    persons: int
    sources: tuple[str, ...]
    """Files with 3D points."""
    cameras: int
    compared: int
    """2D points that were compared with 3D points."""
    reprojection_median_px: float | None = None
    """Of the worst pair of a source and a camera; None where there is no 2D, or nothing is seen."""
    plausible_share: float | None = None
    """Of bodies near the ground, head up, within the pitch's bounds."""


class CheckReport(Record):
    """The outcome of a check."""

    clips: dict[str, ClipFigures]
    findings: tuple[Finding, ...]
    """Empty where nothing is wrong."""


def check_clip(clip: ShippedClip, settings: CheckSettings) -> tuple[ClipFigures, list[Finding]]:
    """Return figures and findings of one clip.

    2D decides where there is any: a fault is named that makes 3D and 2D agree. What is then still
    implausible, or has no 2D, is judged by people who must stand on a pitch and be in sight.
    """
    findings = list(clip.findings)
    agreements = [
        found
        for source in clip.sources
        for view in clip.views
        if (found := agreement(source, view, settings)) is not None
    ]
    findings += agreement_findings(agreements, settings)
    faults = {one.view: one.fault for one in agreements if one.fault.camera is not None}
    views = [_mended(view, faults.get(view.name, SOUND)) for view in clip.views]
    shares = []
    for source in clip.sources:
        repaired = _repaired(source, agreements)
        blind = [
            view
            for view in views
            if not _compared_view(view, agreements)
            and view_share(repaired.points, view.rows) < settings.least_seen
        ]
        fault, before, after = world_fault(repaired, settings)
        shares.append(plausible_share(repaired, settings))
        if fault is not None and fault.points is not None:
            findings.append(_world_finding(source, fault, before, after))
            points = fault.points(repaired)
            repaired = repaired if points is None else repaired.moved(points)
        if repaired.points is source.points and not _compared(source, agreements):
            findings += ground_findings(repaired, settings)
        findings += body_findings(repaired, clip.fps, settings)
        findings += _sight_findings(repaired, blind, settings)
    for view in views:
        findings += camera_findings(view, settings)
    seen = [one.median_px for one in agreements]
    worst = max(seen) if seen and max(seen) < float("inf") else None
    figures = ClipFigures(
        frames=max((len(source.points) for source in clip.sources), default=0),
        persons=max((source.points.shape[1] for source in clip.sources), default=0),
        sources=tuple(source.name for source in clip.sources),
        cameras=len(clip.views),
        compared=sum(one.count for one in agreements),
        reprojection_median_px=worst,
        plausible_share=min(shares) if shares else None,
    )
    return figures, list(_merged(findings))


def _repaired(source: PointSource, agreements: Iterable[Agreement]) -> PointSource:
    """The source with the fault undone that its 2D names most often."""
    faults = [a.fault for a in agreements if a.source == source.name and a.fault.points is not None]
    if not faults:
        return source
    fault = max(faults, key=faults.count)
    points = None if fault.points is None else fault.points(source)
    return source if points is None else source.moved(points)


def _mended(view: View, fault: Fault) -> View:
    if fault.camera is None:
        return view
    return View(view.name, fault.camera(view.rows), view.pixels, view.skeleton)


def _compared(source: PointSource, agreements: Iterable[Agreement]) -> bool:
    return any(one.source == source.name for one in agreements)


def _compared_view(view: View, agreements: Iterable[Agreement]) -> bool:
    return any(one.view == view.name for one in agreements)


def _world_finding(source: PointSource, fault: Fault, before: float, after: float) -> Finding:
    return Finding(
        fault=fault.name,
        kind="convention",
        where=(source.name,),
        says=f"{fault.says}: so people stand on the pitch",
        figures={"shipped_plausible_share": before, "explained_plausible_share": after},
    )


def _sight_findings(
    source: PointSource, views: Iterable[View], settings: CheckSettings
) -> Iterator[Finding]:
    """Cameras that show nobody, and the fault of the camera that would explain it best."""
    lost: dict[tuple[str, str], list[tuple[str, float, float]]] = {}
    for view in views:
        shipped = view_share(source.points, view.rows)
        if shipped >= settings.least_seen:
            continue
        best, most = ("sees_nobody", "the camera shows nobody of the clip"), shipped
        for fault, rows, points in _sights(source, view):
            share = view_share(points, rows)
            if share > max(most + 1e-9, 10.0 * settings.least_seen):
                best, most = (fault.name, f"{fault.says}: so it shows people"), share
        lost.setdefault(best, []).append((view.name, shipped, most))
    for (name, says), group in lost.items():
        yield Finding(
            fault=name,
            kind="damage" if name == "sees_nobody" else "convention",
            where=tuple(f"cameras/{view}" for view, _, _ in group),
            says=says,
            figures={
                "shipped_share_seen": max(shipped for _, shipped, _ in group),
                "explained_share_seen": min(share for _, _, share in group),
            },
        )


def _sights(
    source: PointSource, view: View
) -> Iterator[tuple[Fault, CameraRows, NDArray[np.float64]]]:
    for fault in camera_faults():
        if fault.camera is not None:
            yield fault, fault.camera(view.rows), source.points
    for fault in point_faults():
        points = None if fault.points is None else fault.points(source)
        if points is not None:
            yield fault, view.rows, points


def _merged(findings: Iterable[Finding]) -> Iterator[Finding]:
    """One finding for each fault in the same words, with all places."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.fault, finding.says), []).append(finding)
    for group in groups.values():
        where = tuple(dict.fromkeys(place for finding in group for place in finding.where))
        yield group[0].model_copy(update={"where": where})
