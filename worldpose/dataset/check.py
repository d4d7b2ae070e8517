"""Validation of a data set: named faults and metrics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from data_contracts.release import ClipFigures, Finding
from worldpose.dataset.contents import PointSource, ShippedClip, View
from worldpose.dataset.faults import Fault
from worldpose.dataset.moving_cameras import is_blind, sight_findings, turning_findings
from worldpose.dataset.plausibility import (
    body_findings,
    camera_findings,
    ground_findings,
    pitch_findings,
    plausible_share,
    world_fault,
)
from worldpose.dataset.reprojection import SOUND, Agreement, agreement, agreement_findings
from worldpose.dataset.settings import CheckSettings
from worldpose.dataset.skeletons import box_findings, skeleton_findings


def check_clip(clip: ShippedClip, settings: CheckSettings) -> tuple[ClipFigures, list[Finding]]:
    """Return metrics and findings of one clip.

    2D data takes precedence: a fault is named if its repair makes 3D and 2D agree. Remaining
    implausible data, and data without 2D, is judged by people's position on the pitch and in the
    image.
    """
    findings = list(clip.findings)
    agreements = [
        found
        for source in clip.sources
        for view in clip.views
        if (found := agreement(source, view, settings)) is not None
    ]
    named = {one.source for one in agreements if one.fault is not SOUND}
    slips = [
        found
        for source in clip.sources
        for view in clip.views
        if source.name not in named
        for found in turning_findings(source, view, settings)
    ]
    slipped = {slip.where[0] for slip in slips}
    findings += [
        found
        for found in agreement_findings(agreements, settings)
        if found.fault != "reprojection" or found.where[0] not in slipped
    ]
    findings += [*slips, *_challenge_findings(clip, settings)]
    faults = {one.view: one.fault for one in agreements if one.fault.camera is not None}
    shares = []
    for source in clip.sources:
        repaired = _repaired(source, agreements)
        if not clip.pitch:
            findings += body_findings(repaired, clip.fps, settings)
            continue
        blind = [
            view
            for view in clip.views
            if view.name not in {one.view for one in agreements}
            and is_blind(repaired, view.rows, settings)
        ]
        fault, before, after = world_fault(repaired, settings)
        shares.append(plausible_share(repaired, settings))
        if fault is not None and fault.points is not None:
            findings.append(_world_finding(source, fault, before, after))
            points = fault.points(repaired)
            repaired = repaired if points is None else repaired.moved(points)
        if repaired is source and source.name not in {one.source for one in agreements}:
            findings += ground_findings(source, settings)
        findings += body_findings(repaired, clip.fps, settings)
        findings += pitch_findings(repaired, settings)
        blind = [view for view in blind if is_blind(repaired, view.rows, settings)]
        for finding, reason in sight_findings(repaired, blind, settings):
            findings.append(finding)
            if reason is not None:
                faults |= {place.removeprefix("cameras/"): reason for place in finding.where}
    for view in clip.views:
        findings += camera_findings(_mended(view, faults.get(view.name, SOUND)), settings)
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


def _challenge_findings(clip: ShippedClip, settings: CheckSettings) -> Iterator[Finding]:
    """Yield findings on boxes and skeletons relative to the mid-hip."""
    if clip.given is None:
        return
    yield from box_findings(clip.given.boxes, clip.given.skel_2d, clip.name)
    for view in clip.views:
        if view.name == clip.name:
            both = clip.given.skel_3d, clip.given.skel_2d
            yield from skeleton_findings(*both, view.skeleton, view.rows, clip.name, settings)


def _repaired(source: PointSource, agreements: Iterable[Agreement]) -> PointSource:
    """Repair the source for the fault that its 2D data indicates most often."""
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


def _world_finding(source: PointSource, fault: Fault, before: float, after: float) -> Finding:
    return Finding(
        fault=fault.name,
        kind="convention",
        where=(source.name,),
        says=f"{fault.says}: so people stand on the pitch",
        figures={"shipped_plausible_share": before, "explained_plausible_share": after},
    )


def _merged(findings: Iterable[Finding]) -> Iterator[Finding]:
    """Merge findings of the same fault and text into one, with all places."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.fault, finding.says), []).append(finding)
    for group in groups.values():
        where = tuple(dict.fromkeys(place for finding in group for place in finding.where))
        yield group[0].model_copy(update={"where": where})
