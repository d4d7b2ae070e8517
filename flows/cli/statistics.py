"""Command statistics: size of a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.check import tell_unstated_rate
from flows.cli.console import JsonOption, line, print_json, print_table


def statistics(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Exported data sets, counted together.")
    ],
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Histograms of trajectory and clip lengths, as a PNG."),
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option("--page", help="One HTML page: what there is, and what `check` finds."),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option("--fps", min=0.001, help="Frames in a second; the data set's, or 50."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Count a data set as the paper does: clips, frames, poses, people, distances.

    Example: worldpose statistics exported --picture lengths.png
    """
    from flows.results.statistics import count

    for folder in folders:
        tell_unstated_rate(folder, fps)
    found = count(folders, fps=fps)
    if picture is not None:
        from worldpose.formats.files import whole_file
        from worldpose.reports.data_set import plot_statistics

        with whole_file(picture) as draft:
            draft.write_bytes(plot_statistics(found))
    if page is not None:
        from flows.results.checking import check
        from worldpose.formats.files import whole_file
        from worldpose.reports.data_set import data_set_page

        checks = {str(folder): check(folder, fps=fps) for folder in folders}
        title = ", ".join(folder.resolve().name for folder in folders)
        with whole_file(page) as draft:
            draft.write_text(data_set_page(title, found, checks), encoding="utf-8")
    if as_json:
        print_json(found.model_dump(mode="json"))
        return
    rows = [
        (
            name,
            clip.camera or "-",
            f"{clip.frames}",
            f"{clip.seconds:.1f}",
            f"{clip.persons}",
            f"{clip.poses}",
            f"{sum(clip.trajectories_m):.0f}",
        )
        for name, clip in found.clips.items()
    ]
    titles = ("frames", "s", "people", "poses", "distance m")
    print_table("", ("clip", "camera", *(f">{title}" for title in titles)), rows)
    line(
        f"{len(found.clips)} clips, {found.minutes:.1f} min, {found.frames} frames, "
        f"{found.poses} poses, {found.distance_km:.2f} km, camera {found.camera or '-'}"
    )
    if found.subjects_per_frame is not None and found.speed_m_s is not None:
        line(
            f"{found.subjects_per_frame:.1f} people in a frame, {found.speed_m_s:.1f} m/s, "
            f"trajectories up to {found.longest_trajectory_m or 0.0:.0f} m"
        )
    for written in (picture, page):
        if written is not None:
            line(f"wrote {written}")
