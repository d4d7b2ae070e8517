"""Command calibrate: compute lenses from images or videos of a calibration board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from data_contracts.arrays import Image
from flows.cli.console import errors, line, print_json, print_table
from worldpose.errors import InputError, UsageError, unknown_name
from worldpose.formats.calibration_files import camera_id
from worldpose.video.names import is_video

if TYPE_CHECKING:
    from worldpose.static_calibration.boards import Board, BoardView, LensFit

IMAGES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
FEW_FIELDS: Final = 0.4
"""Share of the image with corners from which on nothing is said [1]."""


def calibrate(
    boards: Annotated[Path, typer.Argument(metavar="BOARDS")],
    columns: Annotated[int, typer.Option(min=2, max=100)],
    rows: Annotated[int, typer.Option(min=2, max=100)],
    square: Annotated[float, typer.Option(min=0.0001, max=10.0)],
    out: Path,
    camera: str | None = None,
    charuco: Annotated[str | None, typer.Option(metavar="DICTIONARY")] = None,
    marker: float | None = None,
    every: Annotated[float, typer.Option(min=0.01, max=60.0)] = 0.5,
    plot: Path | None = None,
) -> None:
    """Compute the lenses of cameras from images or videos of a checkerboard or ChArUco board.

    The file can be edited, and `worldpose import --lens FILE --out MATCH` adds it to a match. The
    pose of a camera comes from clicks.

    Example: worldpose calibrate boards --columns 4 --rows 7 --square 0.06 --out lenses.toml

    Options:
        boards: Folder with a folder of images, or a video, for each camera; or images of one.
        columns: Inner corners along one side of the board.
        rows: Inner corners along the other side.
        square: Side of a square [m].
        out: TOML file of lenses to write.
        camera: Name of the camera, if BOARDS has images of one.
        charuco: The board is a ChArUco board with this dictionary, such as DICT_4X4_50;
            --columns and --rows then count its squares.
        marker: Side of a marker of a ChArUco board [m].
        every: Time between frames of a video [s].
        plot: Plot of coverage and residuals to write: .svg, .pdf or .png.
    """
    from flows.results.outputs import claim_file, require_new
    from worldpose.formats.files import whole_file
    from worldpose.formats.lens_files import write_lens_toml
    from worldpose.geometry.cameras import Camera
    from worldpose.reports.drawing import draw_lens_fits, require_plot
    from worldpose.static_calibration.boards import Board, calibrate_lens

    if plot is not None:
        require_plot(plot)
    if (charuco is None) != (marker is None):
        raise UsageError(
            "--charuco",
            expected="--charuco together with --marker",
            found="one of them",
            todo="Give both, or neither for a checkerboard.",
        )
    require_new(out)
    claim_file(plot, str(boards.resolve()))
    board = Board(columns, rows, square, charuco, marker)
    fits = {}
    files: dict[str, list[str]] = {}
    for name, place in _cameras(boards, camera).items():
        views, size, files[name] = _find_boards(name, place, board, every)
        fits[name] = calibrate_lens(name, views, size)
        Camera.from_lens(fits[name].lens).require_rays(str(place))
    with whole_file(out) as draft:
        write_lens_toml(draft, {name: fit.lens for name, fit in fits.items()})
    if plot is not None:
        draw_lens_fits(fits, plot)
    print_json({"lenses": str(out), "cameras": {n: _as_json(f) for n, f in fits.items()}})
    _print(fits, files)
    line(f"wrote {out}; worldpose import --lens {out} --out MATCH adds it to a match")


def _cameras(boards: Path, camera: str | None) -> dict[str, Path]:
    """Return the folder or video of each camera."""
    camera = None if camera is None else camera_id(camera)
    found = sorted(boards.glob("[!.]*"))
    if any(file.suffix.lower() in IMAGES for file in found) or boards.is_file():
        return {camera or _camera_name(boards): boards}
    places: dict[str, Path] = {}
    for place in found:
        if not (is_video(place) or (place.is_dir() and _images(place))):
            continue
        if (first := places.setdefault(_camera_name(place), place)) != place:
            two, todo = f"{first.name} and {place.name}", "Name each after its camera."
            raise InputError(str(boards), "one folder or video of each camera", two, todo)
    if not places:
        raise InputError(
            str(boards),
            expected="a folder of images or a video for each camera, or images of one camera",
            found="nothing" if not boards.exists() else "none of them",
            todo=f"Name the folders after the cameras; images end with {', '.join(IMAGES)}.",
        )
    if camera is not None and camera not in places:
        raise unknown_name(f"--camera {camera}", camera, places)
    return places if camera is None else {camera: places[camera]}


def _camera_name(place: Path) -> str:
    """Return a camera's id by its folder or video; `int_cam01_img`, as in Pose2Sim, is cam01."""
    name = place.stem if place.is_file() else place.resolve().name
    return camera_id(name.removeprefix("int_").removesuffix("_img"))


def _images(folder: Path) -> list[Path]:
    return [file for file in sorted(folder.iterdir()) if file.suffix.lower() in IMAGES]


def _find_boards(
    name: str, place: Path, board: Board, every: float
) -> tuple[list[BoardView | None], tuple[int, int], list[str]]:
    """Return what `_read_views` finds of the board, or of another one that is perhaps meant."""
    from worldpose.static_calibration.boards import MIN_VIEWS

    found, said = _read_views(place, board, every), ""
    if sum(view is not None for view in found[0]) < MIN_VIEWS:
        for other, difference in board.others(_middle_image(place)):
            views = _read_views(place, other, every)
            if sum(view is not None for view in views[0]) >= MIN_VIEWS:
                found, said = views, difference
                break
    for note in dict.fromkeys([said, *(view.note for view in found[0] if view is not None)]):
        if note:
            line(f"{name}: {note}", to=errors)
    return found


def _middle_image(place: Path) -> Image:
    """Return the middle image of a folder, or of a video."""
    from worldpose.video.files import VideoReader, index_frames

    if not place.is_file():
        files = _images(place)
        return _read_image(files[len(files) // 2])
    index = index_frames(place)
    with VideoReader(place, index) as video:
        return video.frame(len(index) // 2)


def _read_views(
    place: Path, board: Board, every: float
) -> tuple[list[BoardView | None], tuple[int, int], list[str]]:
    """Return the board in each image of a folder, or in frames of a video, the size, and names."""
    from worldpose.static_calibration.boards import choose_views
    from worldpose.video.files import VideoReader, index_frames

    if place.is_file():
        index = index_frames(place)
        numbers = range(0, len(index), max(1, round(every * index.fps)))
        with VideoReader(place, index) as video:
            views, size = choose_views((video.frame(number) for number in numbers), board)
        return views, size, [f"view {n}" for n in range(len(views))]
    found: list[BoardView | None] = []
    sizes: dict[tuple[int, int], Path] = {}
    files = _images(place)
    for file in files:
        image = _read_image(file)
        sizes.setdefault((image.shape[1], image.shape[0]), file)
        found.append(board.find(image))
    if len(sizes) > 1:
        (one, first), (two, second) = list(sizes.items())[:2]
        raise InputError(
            str(place),
            expected="images of one size",
            found=f"{one[0]} x {one[1]} in {first.name}, {two[0]} x {two[1]} in {second.name}",
            todo="Keep the images of one camera and one mode in a folder.",
        )
    return found, next(iter(sizes)), [file.name for file in files]


def _read_image(file: Path) -> Image:
    import numpy as np

    from worldpose.video.folder import decode_image

    image = decode_image(np.fromfile(file, np.uint8), grey=True, turned=False)
    if image is None:
        raise InputError(
            str(file), expected="an image", found="none that OpenCV reads", todo="Save it again."
        )
    return image


def _as_json(fit: LensFit) -> dict[str, object]:
    return {
        "lens": fit.lens.model_dump(mode="json"),
        "rms_px": fit.rms_px,
        "coverage": fit.coverage,
        "bend_m": fit.bend_m,
        "images": int(fit.used.sum()),
        "left_out": {str(n): reason for n, reason in enumerate(fit.reasons) if reason},
    }


def _print(fits: dict[str, LensFit], files: dict[str, list[str]]) -> None:
    """Print a table of the lenses, and what is to know about the images."""
    rows = []
    for name, fit in fits.items():
        lens, (x, y) = fit.lens, fit.lens.principal_point_px
        kind = "fisheye " if lens.lens_model == "fisheye" else ""
        rows.append(
            f"{name}\t{fit.used.sum()} of {len(fit.used)}\t{fit.rms_px:.2f}\t"
            f"{lens.focal_px:.1f} +- {lens.focal_std_px:.1f}\t"
            f"{x:.1f}, {y:.1f} +- {lens.principal_point_std_px:.1f}\t"
            f"{kind}{' '.join(f'{one:.4f}' for one in lens.distortion[:4])}\t"
            f"{100 * fit.coverage:.0f}"
        )
    head = "camera\t>images\t>residual px\t>focal length px\t>principal point px\t"
    head += "k1 k2 p1 p2, fisheye k1 to k4\t>coverage %"
    print_table("lenses", head, rows)
    for name, fit in fits.items():
        for file, reason in zip(files[name], fit.reasons, strict=True):
            if reason:
                line(f"{name}: {file} is left out: {reason}")
        if fit.bend_m > 0.0:
            line(
                f"{name}: the board is bent by {1000.0 * fit.bend_m:.1f} mm, and deviations are "
                "larger by what that moves the lens: fix it to a flat plate, and film it again",
                to=errors,
            )
        if fit.coverage < FEW_FIELDS:
            line(
                f"{name}: only {100 * fit.coverage:.0f} % of the image have corners: distortion "
                "elsewhere is a guess. Add images with the board near the borders."
            )
