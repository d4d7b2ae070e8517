"""Commands statistics, check and release: data sets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from flows.cli.console import errors, line, print_json, print_table
from flows.cli.options import DEFAULT_PROJECT
from worldpose.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from data_contracts.release import CheckReport, Split


def statistics(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...")],
    picture: Path | None = None,
    page: Path | None = None,
    fps: float | None = None,
) -> None:
    """Count a data set as the paper does: clips, frames, poses, people, distances.

    Example: worldpose statistics exported --picture lengths.png

    Options:
        folders: Folders of one exported data set.
        picture: Histograms of trajectory and clip lengths, as a PNG.
        page: Write an HTML page with statistics and check results.
    """
    from flows.results.dataset import count
    from flows.results.outputs import claim_file

    source = ", ".join(str(folder.resolve()) for folder in folders)
    claim_file(picture, source)
    claim_file(page, source)
    for folder in folders:
        tell_unstated_rate(folder, fps)
    found = count(folders, fps=fps)
    if picture is not None:
        from worldpose.formats.files import whole_file
        from worldpose.reports.data_set import plot_statistics

        with whole_file(picture) as draft:
            draft.write_bytes(plot_statistics(found))
    if page is not None:
        from flows.results.dataset import check
        from worldpose.formats.files import whole_file
        from worldpose.reports.data_set import data_set_page

        checks = {str(folder): check(folder, fps=fps) for folder in folders}
        for note in (note for report in checks.values() for note in report.notes):
            line(note, to=errors)
        title = ", ".join(folder.resolve().name for folder in folders)
        with whole_file(page) as draft:
            draft.write_text(data_set_page(title, found, checks), encoding="utf-8")
    print_json(found.model_dump(mode="json"))
    rows = (
        f"{name}\t{clip.camera or '-'}\t{clip.frames}\t{clip.seconds:.1f}\t{clip.persons}\t"
        f"{clip.poses}\t{sum(clip.trajectories_m):.0f}"
        for name, clip in found.clips.items()
    )
    print_table("", "clip\tcamera\t>frames\t>s\t>people\t>poses\t>distance m", rows)
    line(
        f"{len(found.clips)} clips, {found.minutes:.1f} min, {found.frames} frames, "
        f"{found.poses} poses, {found.distance_km:.2f} km, camera {found.camera or '-'}"
    )
    if found.subjects_per_frame is not None and found.speed_m_s is not None:
        line(
            f"{found.subjects_per_frame:.1f} people per frame, {found.speed_m_s:.1f} m/s, "
            f"trajectories up to {found.longest_trajectory_m or 0.0:.0f} m"
        )
    for written in (picture, page):
        if written is not None:
            line(f"wrote {written}")


FAULTY = 1
"""Exit code if the data set has faults."""


def check(
    folder: Annotated[Path, typer.Argument(metavar="DIR")],
    fps: float | None = None,
    body: str | None = None,
    pitch: bool = True,
) -> None:
    """Check whether a data set is consistent, and which convention it violates if not.

    Example: worldpose check exported

    Options:
        folder: Folder of an exported data set.
        body: Body model of pose files without one; the open body.
        pitch: Whether the ground is a football pitch.
    """
    from flows.results.dataset import check as check_data_set

    tell_unstated_rate(folder, fps)
    _print_check(check_data_set(folder, fps=fps, body=body, pitch=pitch))


def _print_check(report: CheckReport) -> None:
    """Print the outcome of a check, and end the command with an exit code if there are findings."""
    for note in report.notes:
        line(note, to=errors)
    print_json({**report.model_dump(mode="json"), "passed": not report.findings})
    rows = (
        f"{name}\t{it.frames}\t{it.persons}\t{it.cameras}\t{it.compared}\t"
        f"{_format_value(it.reprojection_median_px)}\t{_format_value(it.plausible_share)}"
        for name, it in report.clips.items()
    )
    heads = "clip\t>frames\t>people\t>cameras\t>compared\t>reprojection px\t>plausible"
    print_table("", heads, rows)
    for finding in report.findings:
        figures = ", ".join(f"{name} {value:.4g}" for name, value in finding.figures.items())
        line(f"{finding.fault}: {finding.says} [{', '.join(finding.where)}] {figures}".rstrip())
    line(f"{len(report.findings)} findings" if report.findings else "no findings")
    if report.findings:
        raise typer.Exit(FAULTY)


def tell_unstated_rate(folder: Path, fps: float | None) -> None:
    """Print the assumed frame rate, since seconds and speeds depend on it."""
    from flows.results.dataset import USUAL_FPS, stated_rates

    if None in stated_rates(folder, fps).values():
        line(
            f"{folder}: no frame rate is stated: {USUAL_FPS:g} per second is assumed (--fps)",
            to=errors,
        )


def _format_value(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def release(
    matches: Annotated[list[str] | None, typer.Argument(metavar="MATCH[/RUN]...")] = None,
    out: Path | None = None,
    name: str | None = None,
    licence: Annotated[list[str] | None, typer.Option(metavar="[KIND=]FILE")] = None,
    val: Annotated[list[str] | None, typer.Option(metavar="MATCH")] = None,
    test: Annotated[list[str] | None, typer.Option(metavar="MATCH")] = None,
    hidden: Path | None = None,
    footage: Literal["none", "digest", "copy"] = "none",
    subjects: Path | None = None,
    check: Annotated[Path | None, typer.Option(metavar="FOLDER")] = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Write one data set from runs of several matches, or check one.

    Example: worldpose release --out set --name first --licence TERMS.txt tiny-1 tiny-2

    Options:
        matches: Matches of the project; their latest runs, or those named.
        out: New folder of the data set.
        name: Name of the release; pins the runs as release-NAME.
        licence: Text of the licence of all files but footage, or of one kind: poses, joints,
            cameras, boxes or footage.
        val: Match of the validation part; may be given more than once. Others are for training.
        test: Match of the test part, whose truth is hidden; may be given more than once.
        hidden: New folder of that truth, which you do not publish; also to check it.
        footage: Broadcast videos: their digests, or copies.
        subjects: YAML file of people in several clips: subject: [MATCH/NAME, MATCH/CLIP/ID].
        check: Verify this data set instead: files, splits, licences, numbers, poses, boxes.
    """
    from flows.results.data_set_release import ASSETS, check_data_set, write_data_set

    if check is not None:
        _print_check(check_data_set(check, hidden))
        return
    runs: dict[str, str] = {}
    for item in matches or ():
        match, _, run = item.rpartition("/")
        runs |= {match: run} if match and run.isdigit() else {item: "latest"}
    splits: dict[str, Split] = dict.fromkeys(test or (), "test")
    splits |= dict.fromkeys(val or (), "val")
    twice = len(splits) < len([*(test or ()), *(val or ())]) or len(runs) < len(matches or ())
    if out is None or name is None or not runs or twice or not splits.keys() <= runs.keys():
        raise UsageError(
            "worldpose release",
            expected="--out, --name and matches, of which --val and --test name some, each once",
            found=f"matches {', '.join(runs) or 'none'}; splits of {', '.join(splits) or 'none'}",
            todo="worldpose release --out set --name first --licence TERMS.txt MATCH MATCH2.",
        )
    from flows.cli.results import read_licence
    from flows.registering import find_registration
    from flows.results.best_results import Origin, describe_age, open_results
    from worldpose.store.store import Store

    licences: dict[str, str] = {}
    for item in sorted(licence or (), key=lambda item: "=" in item):
        kind, equals, file = item.rpartition("=")
        if equals and kind not in ASSETS:
            raise unknown_name(f"--licence {item}", kind, ASSETS)
        licences |= dict.fromkeys([kind] if equals else ASSETS[:-1], read_licence(Path(file)))
    store, origins = Store.open(project), []
    for match, run in runs.items():
        registration = find_registration(store, match)
        opened = open_results(store, registration.spec.match_id, run)
        if run == "latest" and (later := describe_age(store, opened.record)):
            line(later, to=errors)
        origin = Origin(opened, registration)
        if absent := sorted({clip.id for clip in registration.spec.clips} - {*origin.clips}):
            at = f"run {opened.record.run_id} of {opened.record.match_id}"
            line(f"{at} has no people in {', '.join(absent)}: not in the data set", to=errors)
        origins.append((origin, splits.get(match, "train")))
    manifest = write_data_set(
        *(store, origins, out, name, licences), hidden=hidden, footage=footage, subjects=subjects
    )
    found = manifest.statistics
    print_json({"out": str(out), "statistics": found.model_dump(mode="json")})
    line(
        f"wrote {out}: {len(manifest.clips)} clips; without those of the test part "
        f"{found.subjects} subjects, {found.frames} frames, {found.poses} poses, "
        f"{found.distance_km:.3f} km. Verify it: worldpose release --check"
    )
