"""Command clips: propose clips of a whole programme, and cut out the confirmed ones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress

from data_contracts.arrays import Image
from flows.cli.console import answer, errors, line, print_json, print_table
from flows.results.outputs import claim_file
from worldpose.broadcast_calibration.shots import find_shots
from worldpose.errors import InputError, UsageError
from worldpose.formats.files import whole_file
from worldpose.video.files import VideoReader, index_frames
from worldpose.video.recordings import cut_video

ANALYSED_WIDTH = 320
"""Width of the analysed images [px]."""


def clips(
    programme: Annotated[Path, typer.Argument(metavar="VIDEO")],
    sheet: Path | None = None,
    take: Annotated[str | None, typer.Option(metavar="FIRST:STOP")] = None,
    out: Path | None = None,
) -> None:
    """Propose clips of a programme: shots of the main camera without a cut and with a pan.

    Check the sheet and take the right ones; images are not encoded again.

    Example: worldpose clips feed.mp4 --sheet feed.png

    Options:
        programme: The programme feed.
        sheet: PNG with sample frames of each proposed clip.
        take: Cut out this range of frames instead.
        out: With --take: <match>/broadcast/<clip>.mp4.
    """
    if (take is None) != (out is None) or (take is not None and sheet is not None):
        raise UsageError(
            "worldpose clips",
            expected="--take with --out, or neither",
            found="one of them, or --sheet too",
            todo="Read the help: worldpose clips --help.",
        )
    if take is not None and out is not None:
        _take(programme, take, out)
        return
    claim_file(sheet, str(programme.resolve()))

    index = index_frames(programme)
    lost: list[int] = []
    shots = list(find_shots(_pictures(programme, lost), index.fps))
    if len(lost) == len(index):
        raise InputError(
            str(programme),
            expected="images that can be decoded",
            found=f"none in {len(index)} frames",
            todo="Convert the video with any video tool.",
        )
    if lost:
        line(
            f"{programme}: {len(lost)} of {len(index)} images cannot be decoded, "
            f"the first is {lost[0]}",
            to=errors,
        )
    proposed = [shot for shot in shots if not shot.unfit]
    if sheet is not None:
        from worldpose.reports.broadcast import programme_sheet

        with whole_file(sheet) as draft:
            draft.write_bytes(programme_sheet(proposed))
    print_json(
        {
            "pictures": len(index),
            "shots": [
                {
                    "first": shot.first,
                    "stop": shot.first + shot.count,
                    "seconds": shot.seconds,
                    "pan_widths": shot.pan,
                    "grass": shot.grass,
                    "tallest": shot.tallest,
                    "unfit": shot.unfit,
                }
                for shot in shots
            ],
        }
    )
    rows = (
        f"{shot.first}:{shot.first + shot.count}\t"
        + "{:.0f}:{:04.1f}".format(*divmod(shot.first / index.fps, 60.0))
        + f"\t{shot.seconds:.1f}\t{shot.pan:.2f}\t{100.0 * shot.grass:.0f}"
        for shot in proposed
    )
    columns = "take\t>begins at\t>seconds\t>pan in widths\t>% grass"
    print_table("proposed clips", columns, rows)
    reasons = sorted({reason for shot in shots for reason in shot.unfit})
    for reason in reasons:
        line(f"{sum(reason in shot.unfit for shot in shots)} shots not proposed: {reason}")


def _pictures(programme: Path, lost: list[int]) -> Iterator[tuple[int, Image | None]]:
    """Yield all images, downscaled, with progress on a terminal; add undecodable ones to `lost`."""
    with (
        VideoReader(programme) as video,
        Progress(console=errors, transient=True, disable=not errors.is_terminal) as bars,
    ):
        bar = bars.add_task(programme.name, total=len(video))
        for number, picture in video.readable(width=ANALYSED_WIDTH):
            if picture is None:
                lost.append(number)
            yield number, picture
            bars.update(bar, completed=number + 1)


def _take(programme: Path, take: str, out: Path) -> None:
    """Cut a range of images out, and print the entry for match.yaml."""
    first, _, stop = take.partition(":")
    if not (first.isdecimal() and stop.isdecimal()):
        raise UsageError(
            "--take",
            expected="FIRST:STOP, numbers of pictures",
            found=repr(take),
            todo="Copy one from the table of proposed clips.",
        )
    if out.exists():
        raise UsageError(
            str(out), expected="a new file", found="a file", todo="Choose another name."
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out) as draft:
        offset = cut_video(programme, int(first), int(stop), draft)
    entry: dict[str, Any] = {
        "id": out.stem,
        "first_frame": "?",
        "frame_count": int(stop) - int(first),
        "broadcast": "main",
        "broadcast_offset_frames": offset,
    }
    said = ", ".join(f"{key}: {value}" for key, value in entry.items())
    answer(
        {"video": str(out), "clip": {**entry, "first_frame": None}},
        f"wrote {out}; for match.yaml, first_frame being its match frame:",
        f"  - {{{said}}}",
    )
