"""Shared drawing functions: colours, the pitch, skeletons, labels."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection, PathCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.quiver import Quiver
from matplotlib.text import Annotation
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.conventions import COCO17_BONES
from data_contracts.pitch import PitchSpec
from worldpose.errors import UsageError
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate

if TYPE_CHECKING:
    from worldpose.static_calibration.boards import LensFit
    from worldpose.triangulation.synchronization import Synchronization

PALETTE: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6b4c9a")
"""One colour per person, after Okabe and Ito: distinguishable with any colour vision."""

INK: Final = "#2b2b2b"
PALE: Final = "#9a9a9a"
GRASS: Final = "#f1f5ef"
LINE: Final = "#b5c4b1"
TEMPLATE: Final = "#ffd54a"
"""Colour of markings over a still: on grass, nothing else is this yellow."""
HALO: Final = [withStroke(linewidth=2.5, foreground="white")]
WIDTH: Final = 1540
"""Width of a figure [px]."""
_kept: ContextVar[dict[bytes, Figure] | None] = ContextVar("kept", default=None)


def draw_pitch(axes: Axes, pitch: PitchSpec) -> None:
    """Draw the pitch and its lines from above."""
    corner = (-0.5 * pitch.length, -0.5 * pitch.width)
    axes.add_patch(Rectangle(corner, pitch.length, pitch.width, color=GRASS, zorder=0))
    for line in markings(pitch):
        axes.plot(line[:, 0], line[:, 1], color=LINE, linewidth=1.2, zorder=1)


def style_ground(axes: Axes, pitch: PitchSpec | None) -> None:
    """Style axes that show the ground from above, in metres of the world; None = no pitch."""
    along, across = ("", "") if pitch is None else (", along the touch line", ", across")
    axes.set_xlabel(f"x{along} [m]", color=INK)
    axes.set_ylabel(f"y{across} [m]", color=INK)
    style(axes)


def draw_markings(
    axes: Axes,
    camera: Camera,
    pitch: PitchSpec | None,
    color: str,
    width: float = 1.2,
    zorder: int = 1,
) -> None:
    """Draw the markings as a single camera projects them; nothing without a pitch."""
    for line in markings(pitch) if pitch is not None else ():
        axes.plot(*camera.project(line).T, color=color, linewidth=width, zorder=zorder)


def draw_people(axes: Axes, camera: Camera, tracks: JointTracks, frame: int) -> None:
    """Draw the skeletons of all people as a single camera projects them; `frame` is an index."""
    for person_id, joints in zip(tracks.person_ids, tracks.joints[frame], strict=True):
        draw_skeleton(axes, camera.project(joints), person_color(int(person_id)))


def pitch_corners(pitch: PitchSpec) -> Floats:
    """Return two opposite corners of the pitch (2, 2) [m]."""
    return 0.5 * np.array([[-pitch.length, -pitch.width], [pitch.length, pitch.width]])


def markings(pitch: PitchSpec) -> list[Floats]:
    """Return the painted lines as polylines (n, 3) [m], world, sampled every half metre."""
    template = PitchTemplate.from_spec(pitch)
    samples = template.sample_lines(0.5)
    lines = []
    for marking, name in enumerate(samples.names):
        line = samples.points_world[samples.marking == marking]
        arc = template.arcs.get(name)
        if arc is not None and np.isclose(arc.end_angle - arc.start_angle, 2.0 * np.pi):
            line = np.concatenate([line, line[:1]])
        lines.append(line)
    return lines


def note_undrawn_distortion(cameras: Mapping[str, Camera]) -> dict[str, str]:
    """Return a note on how far lenses move pixels, for a view without it; none below a pixel."""
    found = {}
    for name, camera in cameras.items():
        columns, rows = (np.linspace(0.0, side - 1.0, 33) for side in camera.image_size)
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        flat = camera.focal * camera.normalize(pixels) + camera.principal_point
        shift = np.linalg.norm(flat - pixels, axis=-1)
        found[name] = float(np.nanmax(shift, initial=0.0))
    shown = [f"{name} {shift:.0f} px" for name, shift in found.items() if shift >= 1.0]
    said = f"not drawn; it moves pixels by up to {', '.join(shown)}"
    return {"distortion": said} if shown else {}


def picture_panels(
    titles: Sequence[str],
    corner: ArrayLike,
    side: ArrayLike,
    *,
    still: Image | None = None,
    ground: str = GRASS,
    below: int = 0,
) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels in a row that all show the same part of a camera's image.

    Places are computed, not adjusted to the text, which takes 0.1 s.

    The part has its upper left `corner` (2,) and size `side` (2,) [px] in the image `still`
    (height, width, 3) RGB; without it, the ground has one colour. `below` [px] stays free below the
    panels.
    """
    dpi = 110  # resolution of a figure [px/in]
    (left, top), (across, down) = np.asarray(corner, float), np.asarray(side, float)
    gap = 14  # distance between panels [px]
    width = (WIDTH - gap * (len(titles) - 1)) / len(titles)
    height = round(width * down / across)
    title_height = 32  # above panels [px]
    whole = title_height + height + below
    figure = Figure(figsize=(WIDTH / dpi, whole / dpi), dpi=dpi, facecolor="white")
    panels = []
    for number, title in enumerate(titles):
        start = number * (width + gap)
        axes = figure.add_axes(
            (start / WIDTH, below / whole, width / WIDTH, height / whole),
            xlim=(left, left + across),
            ylim=(top + down, top),
            xticks=[],
            yticks=[],
            facecolor=ground,
        )
        style(axes)
        if still is not None:
            show_image(axes, still)
        axes.set_title(title, color=INK, loc="left", fontsize=12)
        panels.append(axes)
    return figure, panels


class _FittedImage(AxesImage):
    """An image of the size at which a PNG shows it: Matplotlib's conversion would take 0.2 s."""

    def make_image(
        self,
        renderer: Any,  # noqa: ANN401
        magnification: float = 1.0,
        unsampled: bool = False,
    ) -> Any:  # noqa: ANN401
        """Return the RGBA image from its lowest row on, and its place in the figure [px]."""
        pixels = np.asarray(self.get_array())
        x, y, width, height = _box_px(self.axes, self.get_extent())
        if unsampled or magnification != 1.0 or pixels.shape[:2] != (height, width):
            return super().make_image(renderer, magnification, unsampled)
        return np.ascontiguousarray(pixels[::-1]), x, y, None


def show_image(axes: Axes, still: Image) -> None:
    """Show a camera's image (height, width, 3), RGB, or (height, width), grey, behind all else.

    Only the part within the limits of the axes is shown, resampled to the resolution of the figure.
    """
    height, width = still.shape[:2]
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    x0, x1 = max(math.floor(left + 0.5), 0), min(math.ceil(right + 0.5), width)
    y0, y1 = max(math.floor(top + 0.5), 0), min(math.ceil(bottom + 0.5), height)
    if x0 >= x1 or y0 >= y1:
        return  # the part lies outside the image
    extent = (x0 - 0.5, x1 - 0.5, y1 - 0.5, y0 - 0.5)
    _, _, columns, rows = _box_px(axes, extent)
    way = cv2.INTER_AREA if columns < x1 - x0 else cv2.INTER_LINEAR
    part = cv2.resize(still[y0:y1, x0:x1], (max(columns, 1), max(rows, 1)), interpolation=way)
    image = _FittedImage(axes, extent=extent, interpolation="nearest", zorder=0)
    opaque = cv2.COLOR_GRAY2RGBA if still.ndim == 2 else cv2.COLOR_RGB2RGBA
    image.set_data(cv2.cvtColor(part, opaque))
    image.set_clip_path(axes.patch)
    axes.add_image(image)


def _box_px(axes: Any, extent: tuple[float, float, float, float]) -> tuple[int, int, int, int]:  # noqa: ANN401
    """Return x, y, width and height in the figure [px] of an extent in the units of the axes."""
    left, right, bottom, top = extent
    corners = np.rint(axes.transData.transform([(left, bottom), (right, top)])).astype(int)
    (x0, y0), (x1, y1) = corners.tolist()
    return x0, y0, x1 - x0, y1 - y0


def draw_skeleton(axes: Axes, keypoints: NDArray[np.floating], color: str) -> None:
    """Draw bones and joints of one person (17, 2) [px], without NaN joints."""
    gap = np.full((len(COCO17_BONES), 1, 2), np.nan)
    bones = np.concatenate([keypoints[np.array(COCO17_BONES)], gap], axis=1).reshape(-1, 2)
    axes.plot(*bones.T, color=color, linewidth=1.6, solid_capstyle="round", zorder=3)
    axes.plot(*keypoints.T, ".", color=color, markersize=3.52, zorder=3)


def draw_label(
    axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float], color: str
) -> None:
    """Write a label next to a place; a white halo keeps it readable on any background."""
    axes.annotate(
        text,
        at,
        xytext=offset,
        textcoords="offset points",
        color=color,
        fontsize=11,
        fontweight="bold",
        ha="center" if offset[0] == 0 else "left",
        path_effects=HALO,
        zorder=6,
        annotation_clip=True,
    )


def style(axes: Axes) -> None:
    """Set muted colours and small ticks on axes."""
    axes.tick_params(colors=INK, labelsize=9, length=3)
    for spine in axes.spines.values():
        spine.set_color("#d0d0d0")


def person_color(person_id: int) -> str:
    """Return a person's colour, the same in all plots."""
    return PALETTE[person_id % len(PALETTE)]


def rgb(color: str) -> tuple[int, int, int]:
    """Return `#rrggbb` as numbers."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def png(figure: Figure) -> bytes:
    """Return the figure as PNG without date or version: equal figures have equal bytes."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()  # not savefig, which draws twice
    drawn = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
    # By runs of equal bytes: as small as Matplotlib's own PNG, in two thirds of the time.
    runs = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
    _, coded = cv2.imencode(".png", drawn, [cv2.IMWRITE_PNG_COMPRESSION, 1, *runs])
    picture = coded.tobytes()
    kept = _kept.get()
    if kept is not None:
        kept[picture] = figure
    return picture


@contextmanager
def keep_figures() -> Iterator[dict[bytes, Figure]]:
    """Keep the figures that `png` draws meanwhile, by their PNG, in the order of drawing."""
    kept: dict[bytes, Figure] = {}
    token = _kept.set(kept)
    try:
        yield kept
    finally:
        _kept.reset(token)


def write_figure(figure: Figure, stem: Path, caption: str) -> list[Path]:
    """Write a figure as `stem.svg`, `stem.pdf` and data `stem.json`; equal ones as equal files."""
    written = [stem.with_name(f"{stem.name}{suffix}") for suffix in (".svg", ".pdf", ".json")]
    with rc_context({"svg.hashsalt": "worldpose", "svg.fonttype": "none", "pdf.fonttype": 42}):
        for path, dated in zip(written[:2], ("Date", "CreationDate"), strict=True):
            with whole_file(path) as draft:
                figure.savefig(draft, format=path.suffix[1:], metadata={dated: None})
    with whole_file(written[2]) as draft:
        shown = {"caption": caption, "panels": figure_data(figure)}
        draft.write_text(json.dumps(shown, ensure_ascii=False) + "\n", encoding="utf-8")
    return written


def figure_data(figure: Figure) -> list[dict[str, Any]]:
    """Return what each panel of a figure shows: title, labels of its axes, and its series.

    A series has a kind, a label if the figure shows one, and columns of numbers in the units that
    the axes state: lines and points `x`, `y`; bars `x`, `y`, `width`, `height`; arrows `x`, `y`,
    `dx`, `dy`; areas and segments `x`, `y`, each with the `value` of its colour, and None after it.
    An image is named with its size alone: its pixels are in the SVG. None = missing.
    """
    return [
        {
            "title": axes.get_title(),
            "x": axes.get_xlabel(),
            "y": axes.get_ylabel(),
            "series": [series for artist in axes.get_children() for series in _series(artist)],
        }
        for axes in figure.axes
    ]


def _series(artist: Artist) -> Iterator[dict[str, Any]]:
    """Yield what an artist shows, unless it is a part of the panel, such as its frame."""
    label = str(artist.get_label())
    named = {} if not label or label.startswith("_") else {"label": label}
    if isinstance(artist, Line2D):
        yield {"kind": "line", **named, **_columns(("x", "y"), artist.get_xydata())}
    elif isinstance(artist, Quiver):
        moved = np.stack([artist.X, artist.Y, artist.U, artist.V], axis=-1)
        yield {"kind": "arrows", **named, **_columns(("x", "y", "dx", "dy"), moved)}
    elif isinstance(artist, PathCollection):
        yield {"kind": "points", **named, **_columns(("x", "y"), artist.get_offsets())}
    elif isinstance(artist, Collection):
        paths = artist.get_paths()
        colours = artist.get_array()
        given = np.empty(0) if colours is None else np.asarray(colours).ravel()
        values = given if len(given) == len(paths) else np.full(len(paths), np.nan)
        parts = [np.empty((0, 3))]
        for path, value in zip(paths, values, strict=True):
            corners = np.asarray(path.vertices, dtype=np.float64)
            parts.append(np.insert(corners, 2, value, axis=1))
            parts.append(np.full((1, 3), np.nan))
        found = _columns(("x", "y", "value"), np.concatenate(parts))
        if paths:
            yield {"kind": "areas", **named, **found}
    elif isinstance(artist, Rectangle) and artist.axes is not None:
        if artist is not artist.axes.patch:
            sides = [*artist.get_xy(), artist.get_width(), artist.get_height()]
            yield {"kind": "bar", **named, **_columns(("x", "y", "width", "height"), [sides])}
    elif isinstance(artist, AxesImage):
        height, width = np.asarray(artist.get_array()).shape[:2]
        yield {"kind": "image", **named, "width": width, "height": height}
    elif isinstance(artist, Annotation):
        yield {"kind": "text", "text": artist.get_text(), **_columns(("x", "y"), [artist.xy])}


def _columns(names: Sequence[str], rows: ArrayLike) -> dict[str, list[float | None]]:
    values = np.ma.filled(np.ma.asarray(rows, dtype=np.float64), np.nan)
    return {
        name: [float(f"{each:.7g}") if np.isfinite(each) else None for each in column]
        for name, column in zip(names, values.T, strict=True)
    }


def require_plot(path: Path) -> None:
    """Raise UsageError unless a file name has the suffix of a plot."""
    # Forms of a plot.
    forms = (".svg", ".pdf", ".png")
    if path.suffix.lower() not in forms:
        expected = f"a file name that ends with {', '.join(forms)}"
        raise UsageError(str(path), expected, repr(path.suffix), "Rename it.")


def draw_synchronization(found: Synchronization, names: Sequence[str], path: Path) -> None:
    """Write a plot of each camera's matches by its clock offset; the suffix is the form."""
    figure = Figure(figsize=(7.0, 1.3 * len(names) + 0.8), layout="constrained")
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for panel, name, matches, late, std, reason in zip(
        panels, names, found.matches, found.late, found.std, found.reasons, strict=True
    ):
        panel.set_ylabel(name)
        panel.grid(color=LINE, linewidth=0.5)
        panel.plot(found.shifts, matches, color=PALETTE[0], linewidth=1.2)
        if np.isfinite(late):
            panel.axvline(late, color=PALETTE[1], linewidth=1.2)
            panel.axvspan(late - 2.0 * std, late + 2.0 * std, color=PALETTE[1], alpha=0.25)
            panel.set_title(
                f"{round(late, 2) + 0.0:+.2f} frames, standard deviation {std:.2f}", fontsize=8
            )
        else:
            panel.set_title(reason, fontsize=8)
    panels[-1].set_xlabel("later than the median camera [frames]")
    figure.supylabel(
        "matches with people of other cameras, above their usual number [per frame]", fontsize=8
    )
    with whole_file(path) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())


def draw_lens_fits(fits: Mapping[str, LensFit], path: Path) -> None:
    """Write a plot of board corners, their residuals, and residuals by radius, by camera."""
    residual_share = 0.02  # drawn length of the rms residual, of the image's side [1]
    figure = Figure(figsize=(8.0, 3.2 * len(fits)), layout="constrained")
    rows = figure.subplots(len(fits), 2, squeeze=False)
    for (seen, radial), (name, fit) in zip(rows, fits.items(), strict=True):
        width, height = fit.lens.image_size
        x, y = fit.pixels.T
        longer = residual_share * max(width, height) / max(fit.rms_px, 1e-6)
        seen.quiver(x, y, *(longer * fit.residuals.T), angles="xy", scale_units="xy", scale=1.0)
        seen.scatter(x, y, s=4, c=fit.image, cmap="tab20")
        seen.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
        seen.set_title(
            f"{name}: {fit.used.sum()} images, {100 * fit.coverage:.0f} % covered, residuals "
            f"x {longer:.0f}",
            fontsize=8,
        )
        radius = np.linalg.norm(fit.pixels - np.array(fit.lens.principal_point_px), axis=1)
        radial.scatter(radius, np.linalg.norm(fit.residuals, axis=1), s=4, color=PALETTE[0])
        radial.set(xlabel="distance from the principal point [px]", ylabel="residual [px]")
        radial.set(xlim=(0, 0.5 * float(np.hypot(width, height))), ylim=(0, None))
        radial.set_title(f"root mean square {fit.rms_px:.2f} px", fontsize=8)
    with whole_file(path) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())
