"""Validation of a data set: named faults and metrics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.release import ClipFigures, Finding
from worldpose.dataset import faults as known_faults
from worldpose.dataset import plausibility
from worldpose.dataset.contents import PointSource, ShippedClip, convention, sample_evenly
from worldpose.dataset.faults import LIMITS
from worldpose.formats.release_cameras import CameraRows
from worldpose.geometry.boxes import box_iou


def box_findings(boxes: Floats, skel_2d: Floats, clip: str) -> Iterator[Finding]:
    """Yield boxes without their skeletons, and whether another number order explains it.

    Boxes are (frames, persons, 4) as in the file, skeletons (frames, persons, points, 2) [px].
    """
    # Minimum median intersection over union of valid boxes and those around 2D skeletons [1]:
    # bodies extend beyond joints, so 0.5 to 0.7 is normal.
    overlap = 0.35
    shipped = _overlap(boxes, skel_2d)
    if shipped >= overlap:
        return
    start, rest = boxes[..., :2], boxes[..., 2:]
    others = {
        "x y width height": np.concatenate([start, start + rest], axis=-1),
        "the middle's x y, width height": np.concatenate(
            [start - 0.5 * rest, start + 0.5 * rest], axis=-1
        ),
        "y0 x0 y1 x1": boxes[..., [1, 0, 3, 2]],
    }
    overlaps = {name: _overlap(other, skel_2d) for name, other in others.items()}
    best = max(overlaps, key=lambda name: overlaps[name])
    known = overlaps[best] >= overlap
    yield Finding(
        fault="box_format" if known else "boxes",
        kind="convention" if known else "damage",
        where=(f"boxes of {clip}",),
        says=f"boxes are {best} and not x0 y0 x1 y1"
        if known
        else "boxes are not around the 2D skeletons",
        figures={"overlap": shipped, "explained_overlap": overlaps[best]},
    )


def skeleton_findings(
    skel_3d: Floats, skel_2d: Floats, skeleton: tuple[str, ...], rows: CameraRows, clip: str
) -> Iterator[Finding]:
    """Yield 3D skeletons in camera axes that no translation brings onto their 2D.

    Every body is translated to minimize its 2D residual; the remaining residual indicates other
    axes. The residual does not depend on body size, so units are checked by thigh lengths.
    Skeletons are (frames, persons, points, 3) as in the file, and their 2D [px].
    """
    where = (f"skel_3d of {clip}",)
    count = len(rows.intrinsics) if len(rows.intrinsics) > 1 else len(skel_3d)
    known = np.isfinite(skel_3d[:count]).all((-1, -2)) & np.isfinite(skel_2d[:count]).all((-1, -2))
    frame, person = np.nonzero(known)
    if not len(frame):
        return
    # Maximum number of sampled bodies.
    max_bodies = 400
    picked = sample_evenly(len(frame), max_bodies)
    frame, person = frame[picked], person[picked]
    bodies, pixels = skel_3d[frame, person], skel_2d[frame, person]
    upper, lower = (skeleton.index(f"left_{name}") for name in plausibility.BONES["thighs"])
    thigh = float(np.median(np.linalg.norm(bodies[:, upper] - bodies[:, lower], axis=-1)))
    for unit, size in (("millimetres", 1000.0), ("centimetres", 100.0)):
        if LIMITS.bones_m[0] <= thigh / size <= LIMITS.bones_m[1]:
            says = f"skeletons are in {unit} and not in metres"
            yield convention(unit, says, *where, thigh=thigh)
            bodies = bodies / size
    row = frame if len(rows.intrinsics) > 1 else np.zeros_like(frame)
    lens = rows.lens()[row]
    plane, focal = lens.normalize(pixels), lens.focal
    told = np.isfinite(plane).all((-1, -2))
    if not told.any():
        return
    row, bodies, plane, focal = row[told], bodies[told], plane[told], focal[told]
    as_shipped = "the camera's x, y, z"
    guesses = {as_shipped: bodies}
    for name, axes in known_faults.axis_orders():
        guesses[f"the camera's {name}"] = bodies @ axes
    turned = rows.rotation[row]
    posed = np.isfinite(turned).all((-1, -2))
    left = {name: _left(guess, plane, focal) for name, guess in guesses.items()}
    if posed.any():
        in_world = np.einsum("nab,njb->nja", turned[posed], bodies[posed])
        left["the world's x, y, z"] = _left(in_world, plane[posed], focal[posed])
    best = min(left, key=lambda name: left[name])
    shipped, least = left[as_shipped], left[best]
    if shipped - least > LIMITS.min_gain_px and least < LIMITS.max_share_left * shipped:
        says = f"x, y, z of the skeletons are {best} and not the camera's"
        figures = {"shipped_median_px": min(shipped, 1e6), "explained_median_px": least}
        yield convention("skeleton_axes", says, *where, **figures)


def _overlap(boxes: Floats, skel_2d: Floats) -> float:
    """Return the median intersection over union with boxes around the 2D points; 1 without any."""
    known = np.isfinite(skel_2d).all((-1, -2)) & np.isfinite(boxes).all(-1)
    if not np.any(known):
        return 1.0
    points = skel_2d[known]
    around = np.concatenate([points.min(1), points.max(1)], axis=-1)
    return float(np.median(box_iou(boxes[known][:, None], around[:, None])))


def _left(bodies: Floats, plane: Floats, focal: Floats) -> float:
    """Return the median 2D residual [px] of bodies after optimal translation.

    `bodies` (n, points, 3) [m] are in camera axes, `plane` (n, points, 2) the undistorted 2D at
    depth 1, `focal` (n, 2) [px].
    """
    # x (Z + tz) = X + tx, and the same for y: linear in the translation.
    ones, zeros = np.ones_like(plane[..., 0]), np.zeros_like(plane[..., 0])
    across = np.stack([ones, zeros, -plane[..., 0]], axis=-1)
    down = np.stack([zeros, ones, -plane[..., 1]], axis=-1)
    rows = np.concatenate([across, down], axis=1)
    deep = plane * bodies[..., 2:] - bodies[..., :2]
    given = np.concatenate([deep[..., 0], deep[..., 1]], axis=1)
    normal = np.einsum("nki,nkj->nij", rows, rows)
    place = np.linalg.solve(normal, np.einsum("nki,nk->ni", rows, given)[..., None])
    seen = bodies + place.swapaxes(-1, -2)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (seen[..., :2] / seen[..., 2:] - plane) * focal[:, None]
    far = np.linalg.norm(away, axis=-1)
    return float(np.median(np.where(seen[..., 2] > 0.0, far, np.inf)))


def check_clip(clip: ShippedClip) -> tuple[ClipFigures, list[Finding]]:
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
        if (found := known_faults.compare_view(source, view)) is not None
    ]
    named = {one.source for one in agreements if one.fault is not known_faults.SOUND}
    slips = [
        found
        for source in clip.sources
        for view in clip.views
        if source.name not in named
        for found in plausibility.turning_findings(source, view)
    ]
    slipped = {slip.where[0] for slip in slips}
    findings += [
        found
        for found in known_faults.agreement_findings(agreements)
        if found.fault != "reprojection" or found.where[0] not in slipped
    ]
    findings += [*slips, *_challenge_findings(clip)]
    faults = {one.view: one.fault for one in agreements if one.fault.camera is not None}
    shares = []
    for source in clip.sources:
        repaired = _repair_source(source, agreements)
        if not clip.pitch:
            findings += plausibility.body_findings(repaired, clip.fps)
            continue
        blind = [
            view
            for view in clip.views
            if view.name not in {one.view for one in agreements}
            and plausibility.is_blind(repaired, view.rows)
        ]
        fault, before, after = plausibility.world_fault(repaired)
        shares.append(plausibility.plausible_share(repaired))
        if fault is not None and fault.points is not None:
            repair = {"shipped_plausible_share": before, "explained_plausible_share": after}
            says = f"{fault.says}: so people stand on the pitch"
            findings.append(convention(fault.name, says, source.name, **repair))
            points = fault.points(repaired)
            repaired = repaired if points is None else repaired.with_points(points)
        if repaired is source and source.name not in {one.source for one in agreements}:
            findings += plausibility.ground_findings(source)
        findings += plausibility.body_findings(repaired, clip.fps)
        findings += plausibility.pitch_findings(repaired)
        blind = [view for view in blind if plausibility.is_blind(repaired, view.rows)]
        for finding, reason in plausibility.visibility_findings(repaired, blind):
            findings.append(finding)
            if reason is not None:
                faults |= {place.removeprefix("cameras/"): reason for place in finding.where}
    for view in clip.views:
        fault = faults.get(view.name, known_faults.SOUND)
        rows = view.rows if fault.camera is None else fault.camera(view.rows)
        findings += plausibility.camera_findings(view.name, rows)
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
    return figures, list(_merge_findings(findings))


def _challenge_findings(clip: ShippedClip) -> Iterator[Finding]:
    """Yield findings on boxes and skeletons relative to the mid-hip."""
    if clip.given is None:
        return
    yield from box_findings(clip.given.boxes, clip.given.skel_2d, clip.name)
    for view in clip.views:
        if view.name == clip.name:
            yield from skeleton_findings(
                clip.given.skel_3d, clip.given.skel_2d, view.skeleton, view.rows, clip.name
            )


def _repair_source(
    source: PointSource, agreements: Iterable[known_faults.Agreement]
) -> PointSource:
    """Repair the source for the fault that its 2D data indicates most often."""
    faults = [a.fault for a in agreements if a.source == source.name and a.fault.points is not None]
    if not faults:
        return source
    fault = max(faults, key=faults.count)
    points = None if fault.points is None else fault.points(source)
    return source if points is None else source.with_points(points)


def _merge_findings(findings: Iterable[Finding]) -> Iterator[Finding]:
    """Merge findings of the same fault and text into one, with all places."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.fault, finding.says), []).append(finding)
    for group in groups.values():
        where = tuple(dict.fromkeys(place for finding in group for place in finding.where))
        yield group[0].model_copy(update={"where": where})
