"""Page about a data set: statistics and findings of its check; plot of methods' people in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from data_contracts.arrays import Floats
from data_contracts.release import CheckReport, DataSetManifest, DataSetStatistics, RigCamera
from worldpose.dataset.benchmark import Sample
from worldpose.reports.drawing import GRASS, INK, PALE, draw_skeleton, person_color, png, style
from worldpose.reports.html_page import CaptionedImage, Failure, Section, Table, whole_page


def data_set_page(
    title: str,
    found: DataSetStatistics,
    checks: Mapping[str, CheckReport],
    manifest: DataSetManifest | None = None,
) -> str:
    """Return an HTML page of statistics and findings; with a manifest it is the datasheet."""
    people = "-" if found.subjects_per_frame is None else f"{found.subjects_per_frame:.1f}"
    wrong = sum(len(report.findings) for report in checks.values())
    tiles = [
        (f"{found.minutes:.1f} min", f"{found.frames:,} frames"),
        (f"{len(found.clips)}", "clip" if len(found.clips) == 1 else "clips"),
        (people, "people per frame"),
        (f"{found.poses:,}", "3D poses"),
        (f"{found.distance_km:.1f} km", "run and walked by all"),
        ("passed" if not wrong else f"{wrong} wrong", "check of cameras, poses and 2D"),
    ]
    about, sections = f"Data set of {', '.join(checks)}", [counted_section(found)]
    if manifest is not None:
        about = f"World: {manifest.conventions.world}"
        tiles.insert(0, (f"{found.subjects}", "subjects"))
        terms = Table("", ("files", "licence"), tuple(manifest.licences.items()))
        sections = [_composition(manifest), *sections, Section("Licences", (terms,))]
    return whole_page(title, about, (*sections, _check_section(checks)), tiles=tiles)


def _composition(manifest: DataSetManifest) -> Section:
    """Return the splits with their runs, and the subjects of several clips."""
    found, clips = manifest.statistics.clips, manifest.clips
    splits, clips_of = [], dict[str, list[str]]()
    for split in dict.fromkeys(clip.split for clip in clips.values()):
        own = {name: clip for name, clip in clips.items() if clip.split == split}
        said = (f"{c.match_id}, run {c.run_id}: {c.usability.verdict}" for c in own.values())
        runs = dict.fromkeys(said)
        people = {subject for clip in own.values() for subject in clip.subjects}
        counts = [len(own), sum(clip.frames for clip in own.values())]
        if split != "test":
            poses = sum(found[name].poses for name in own)
            metres = sum(sum(found[name].trajectories_m) for name in own)
            counts += [len(people), poses, round(metres)]
        told = *(f"{each:,}" for each in counts), *("hidden",) * (5 - len(counts))
        models = ", ".join({clip.body_model for clip in own.values()})
        splits.append((split, "; ".join(runs), models, *told))
        for name, clip in own.items():
            for subject in clip.subjects:
                clips_of.setdefault(subject, []).append(name)
    numbers = (">clips", ">frames", ">subjects", ">poses", ">metres")
    several = tuple((s, ", ".join(names)) for s, names in clips_of.items() if len(names) > 1)
    blocks = [Table("", ("split", "matches", "body model", *numbers), tuple(splits))]
    if several:
        blocks.append(Table("Subjects of several clips", ("subject", "clips"), several))
    blocks.append(_static_cameras(manifest))
    lead = (
        "A match belongs to one split, and so does every subject. Nameless people without an entry "
        "in the registry count once per clip. The truth of a test part is hidden: the part has "
        "boxes, and cameras with the pose of the first frame alone. Statistics are without it. "
        "subjects.npz has a shape of each subject that static cameras film, by body model."
    )
    return Section("Composition", tuple(blocks), lead)


def _static_cameras(manifest: DataSetManifest) -> Table:
    """Return static cameras by match: sizes, lenses other than Brown's, views that change."""
    rigs: dict[str, dict[str, RigCamera]] = {}
    changed: dict[str, list[str]] = {}
    for name, clip in manifest.clips.items():
        if clip.split == "test":
            continue
        rig = clip.rig or {}
        rigs.setdefault(clip.match_id, {}).update(rig)
        moved = (f"{each} in {name}" for each, camera in rig.items() if camera.changes)
        changed.setdefault(clip.match_id, []).extend(moved)
    rows = []
    for match, rig in rigs.items():
        sizes = dict.fromkeys("{} x {}".format(*camera.image_size) for camera in rig.values())
        lenses = (
            f"{name}: {lens['lens_model']}, "
            + ("left out" if (off := lens["max_error_px"]) is None else f"{off:.2g} px off")
            for name, camera in rig.items()
            if (lens := camera.lens)
        )
        said = (", ".join(each) or "-" for each in (sizes, lenses, changed[match]))
        rows.append((match, f"{len(rig)}", *said))
    titles = ("match", ">cameras", "images [px]", "lenses other than Brown's", "views that change")
    return Table("Static cameras, cameras/<clip>/<camera>.npz", titles, tuple(rows))


def counted_section(found: DataSetStatistics) -> Section:
    """Return the row of the paper's table of data sets, its histograms, and a table of clips."""
    row = (
        found.camera or "-",
        _number(found.subjects_per_frame, ".1f"),
        f"{found.frames:,}",
        f"{found.poses:,}",
        f"{found.minutes:.2f}",
        f"{found.distance_km:.3f}",
        _number(found.speed_m_s, ".2f"),
        _number(found.longest_trajectory_m, ".1f"),
    )
    columns = (
        *("camera", ">people per frame", ">frames", ">poses", ">minutes", ">distance km"),
        *(">mean speed m/s", ">longest way m"),
    )
    about = "Histograms of trajectory lengths and of clip lengths."
    picture = CaptionedImage(about, plot_statistics(found))
    blocks: list[Table | CaptionedImage] = [Table("", columns, (row,)), picture]
    if len(found.clips) > 1:
        rows = tuple(
            (
                name,
                clip.camera or "-",
                f"{clip.frames:,}",
                f"{clip.seconds:.1f}",
                f"{clip.persons}",
                f"{clip.poses:,}",
                f"{sum(clip.trajectories_m):,.0f}",
            )
            for name, clip in found.clips.items()
        )
        titles = ("clip", "camera", ">frames", ">seconds", ">people", ">poses", ">distance m")
        blocks.append(Table("Clips", titles, rows))
    lead = (
        "Camera: S stands still, M turns, M+Z also zooms. A pose is one person in one frame. "
        "Distances are path lengths over the ground, summed from frame to frame."
    )
    return Section("Statistics", tuple(blocks), lead)


def _check_section(checks: Mapping[str, CheckReport]) -> Section:
    """Return the findings, then the metrics of every clip."""
    findings = tuple(
        (folder, Failure(finding.fault), finding.says, ", ".join(finding.where))
        for folder, report in checks.items()
        for finding in report.findings
    )
    clips = tuple(
        (
            name if len(checks) == 1 else f"{folder}/{name}",
            f"{clip.persons}",
            f"{clip.cameras}",
            f"{clip.compared:,}",
            _number(clip.reprojection_median_px, ".3f"),
            _number(None if clip.plausible_share is None else 100 * clip.plausible_share, ".1f"),
        )
        for folder, report in checks.items()
        for name, clip in report.clips.items()
    )
    titles = ("clip", ">people", ">cameras", ">2D points", ">reprojection px", ">plausible %")
    found = Table("Faults", ("folder", "fault", "description", "where"), findings)
    lead = (
        "3D is projected into the cameras and compared with the 2D, where there is any; people "
        "must be of human size and speed, stand on the pitch and be in sight."
    )
    tables = [found] if findings else []
    return Section("Check", (*tables, Table("Clips", titles, clips)), lead)


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def plot_statistics(statistics: DataSetStatistics) -> bytes:
    """Return a PNG with the histograms of trajectory lengths and of clip lengths."""
    ways = [way for clip in statistics.clips.values() for way in clip.trajectories_m]
    lengths = [clip.seconds for clip in statistics.clips.values()]
    figure = Figure(figsize=(14.0, 4.2), dpi=110, layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    _histogram(left, ways, "trajectory length per person [m]", "trajectories")
    _histogram(right, lengths, "clip length [s]", "clips")
    people = statistics.subjects_per_frame
    figure.suptitle(
        f"{len(statistics.clips)} {'clip' if len(statistics.clips) == 1 else 'clips'}, "
        f"{statistics.minutes:.1f} min, {statistics.frames:,} frames, {statistics.poses:,} poses, "
        f"{statistics.distance_km:.1f} km"
        + (f", {people:.1f} people per frame" if people is not None else ""),
        color=INK,
        fontsize=12,
    )
    return png(figure)


def bin_edges(values: Sequence[float]) -> Floats:
    """Return edges from 0 to beyond the maximum, 1, 2 or 5 times a power of ten apart."""
    top = max(values, default=0.0)
    if top <= 0.0:
        return np.array([0.0, 1.0])
    max_bars = 20  # of a histogram, of one round width
    power = 10.0 ** np.floor(np.log10(top / max_bars))
    width = next(power * step for step in (1.0, 2.0, 5.0, 10.0) if power * step * max_bars >= top)
    edges: Floats = np.arange(np.floor(top / width) + 2.0) * width
    return edges


def _histogram(axes: Axes, values: Sequence[float], title: str, count: str) -> None:
    style(axes)
    bar = "#3d6fa3"
    axes.hist(values, bins=bin_edges(values).tolist(), color=bar, edgecolor="white")
    axes.set_xlabel(title, color=INK)
    axes.set_ylabel(count, color=INK)
    axes.grid(axis="y", color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))


def plot_methods(sample: Sample) -> bytes:
    """Return a PNG with a column per method: its people, coloured, over the true ones, grey.

    The first row is the camera's view, or that from above without a camera. The second is the view
    from the side, along the touch line.
    """
    count, camera = len(sample.found), sample.camera

    def views(people: Floats) -> tuple[Floats, Floats]:
        return people[..., :2] if camera is None else camera.project(people), people[..., 1:]

    corners = []
    for points in views(sample.true.reshape(-1, 3)):
        known = points[np.isfinite(points).all(axis=-1)]
        known = known if len(known) else np.array([[-1.0, -1.0], [1.0, 1.0]])  # nobody is true
        low, high = known.min(axis=0), known.max(axis=0)
        room = max(0.08 * float((high - low).max()), 1e-3)
        corners.append((low - room, high + room))
    heights = [4.2 * min((high - low)[1] / (high - low)[0], 1.0) for low, high in corners]
    size = (4.6 * max(count, 2), sum(heights) + 1.8)
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    panels = figure.subplots(2, count, squeeze=False, height_ratios=heights)
    labels = "from above, y [m]" if camera is None else "camera view, y [px]", "side view, z [m]"
    for column, (name, found) in enumerate(sample.found.items()):
        for row, (low, high) in enumerate(corners):
            axes = panels[row, column]
            for person, (true, mine) in enumerate(zip(sample.true, found, strict=True)):
                draw_skeleton(axes, views(true)[row], PALE)
                draw_skeleton(axes, views(mine)[row], person_color(person))
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axes.set(facecolor=GRASS, ylabel="" if column else labels[row])
            style(axes)
        panels[0, column].set_title(name, color=INK, fontsize=12)
        panels[1, column].set_xlabel("y, across the pitch [m]", color=INK)
        if camera is not None:
            panels[0, column].invert_yaxis()
    title = f"{sample.clip}, frame {sample.frame}: truth grey, predictions after the alignment"
    figure.suptitle(title, color=INK, fontsize=12)
    return png(figure)
