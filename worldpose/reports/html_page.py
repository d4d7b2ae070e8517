"""Self-contained HTML pages from images, tables and scenes, without external resources."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import count
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17_BONES
from data_contracts.pitch import PitchSpec
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry import Camera

UNIT: Final = 0.005
"""Resolution of joint coordinates [m]: 164 m to either side fit into 16 bits."""
MISSING: Final = -32768
RATE: Final = 25.0
"""Maximum frames per second [1/s]; the browser interpolates."""
NUMBERS: Final = 1_500_000
"""Maximum coordinates per clip: 4 MB of text, or 58 s of 20 people."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Content of the 3D view of one clip.

    Attributes:
        caption: names the clip.
        tracks: all people.
        fps: frames per second [1/s].
        cameras: single static cameras by id.
        broadcast: a batch, one per frame of `tracks`; None without a broadcast camera.
        pitch: draw its markings; None without a pitch.
    """

    caption: str
    tracks: JointTracks
    fps: float
    cameras: Mapping[str, Camera]
    broadcast: Camera | None = None
    pitch: PitchSpec | None = None


def scene_html(scene: Scene) -> str:
    """Return the HTML of a scene for the page's script."""
    data = json.dumps(_content(scene), separators=(",", ":"), allow_nan=False)
    # Only this text could end the enclosing element.
    data = data.replace("</", "<\\/")
    buttons = "".join(
        f'<button type="button" data-do="{name}">{label}</button>'
        for name, label in (
            ("play", "Play"),
            ("home", "Perspective"),
            ("above", "From above"),
            ("side", "From the side"),
            ("through", "Broadcast camera"),
        )
    )
    caption = escape(scene.caption)
    return (
        f'<div class="scene"><canvas tabindex="0" role="img" aria-label="{caption}"></canvas>'
        f'<div class="bar">{buttons}<input type="range" min="0" value="0" step="any" '
        'aria-label="Time"><output></output></div>'
        f'<script type="application/json">{data}</script></div>'
    )


def _content(scene: Scene) -> dict[str, object]:
    from worldpose.reports.drawing import HIPS, markings, person_color

    joints = scene.tracks.joints
    every = max(round(scene.fps / RATE), math.ceil(joints.size / NUMBERS), 1)
    shown = joints[::every]
    hips = shown[:, :, HIPS].mean(2)
    there = hips[np.isfinite(hips).all(-1)]
    there = there if len(there) else np.zeros((1, 3))
    low, high = np.percentile(there[:, :2], [2, 98], axis=0)
    middle = 0.5 * (low + high)
    return {
        "first": int(scene.tracks.frames[0]) if len(scene.tracks.frames) else 0,
        "every": every,
        "fps": scene.fps,
        "frames": len(shown),
        "persons": shown.shape[1],
        "ids": [str(person) for person in scene.tracks.person_ids],
        "colors": [person_color(int(person)) for person in scene.tracks.person_ids],
        "bones": [list(bone) for bone in COCO17_BONES],
        "unit": UNIT,
        "joints": _text(_whole(shown)),
        "middle": [*_round_values(middle), 0.8],
        "reach": round(max(9.0, 0.75 * float(np.linalg.norm(high - low))), 1),
        "markings": []
        if scene.pitch is None
        else [_round_values(line) for line in markings(scene.pitch)],
        "grid": [] if scene.pitch is not None else _grid(middle),
        "cameras": [
            {"name": name, "center": _round_values(camera.center)}
            for name, camera in scene.cameras.items()
        ],
        "broadcast": None
        if scene.broadcast is None
        else _text(_moving_camera_rows(scene.broadcast, every)),
    }


def _whole(joints: NDArray[np.float64]) -> NDArray[np.int16]:
    """Return joints in integer units; `MISSING` for missing or too distant joints."""
    known = np.isfinite(joints) & (np.abs(joints) < -MISSING * UNIT - 1.0)
    scaled = np.where(known, joints, 0.0) / UNIT
    whole = np.where(known.all(-1, keepdims=True), np.round(scaled), MISSING)
    return whole.astype("<i2")


def _moving_camera_rows(camera: Camera, every: int) -> NDArray[np.float32]:
    """Return rotation, translation, focal length, width and height of every shown frame."""
    pose = camera.cam_from_world
    count = len(pose.translation)
    size = np.broadcast_to(camera.image_size, (count, 2))
    rows = np.concatenate(
        [pose.rotation.reshape(count, 9), pose.translation, camera.focal[:, :1], size], axis=1
    )
    return rows[::every].astype("<f4")


def _grid(middle: NDArray[np.float64]) -> list[list[list[float]]]:
    """Return a ground grid of 1 m spacing, for scenes without markings."""
    around = np.round(middle)
    lines = []
    for step in np.arange(-8.0, 9.0):
        for axis in (0, 1):
            ends = np.zeros((2, 3))
            ends[:, axis] = around[axis] + step
            ends[:, 1 - axis] = around[1 - axis] + np.array([-8.0, 8.0])
            lines.append(_round_values(ends))
    return lines


def _text(numbers: NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode("ascii")


def _round_values(values: NDArray[np.float64]) -> list:  # type: ignore[type-arg]
    return np.round(values, 2).tolist()  # type: ignore[no-any-return]


@dataclass(frozen=True)
class CaptionedImage:
    """A PNG with a caption."""

    caption: str
    png: bytes


@dataclass(frozen=True)
class Table:
    """A table with a heading.

    Attributes:
        heading: title of the table.
        columns: titles; the prefix ">" marks numeric columns.
        rows: rows of text.
    """

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Section:
    """A section of the page with a link in its navigation bar.

    Attributes:
        heading: also in the navigation bar.
        blocks: blocks in this order.
        lead: introduction.
    """

    heading: str
    blocks: tuple[CaptionedImage | Table | Scene, ...]
    lead: str = ""


class Failure(str):
    """Text of a table cell with failure style."""


@dataclass(frozen=True)
class Folded:
    """Collapsible tables at the end of a page; all but the first are folded.

    Attributes:
        heading: also in the navigation bar.
        tables: tables without rows are left out.
    """

    heading: str
    tables: tuple[Table, ...]


def whole_page(
    title: str,
    about: str,
    sections: Sequence[Section],
    *,
    tiles: Sequence[tuple[str, str]] = (),
    last: Folded | None = None,
) -> str:
    """Return a whole HTML page.

    Args:
        title: heading of the page.
        about: subtitle.
        sections: sections of the page; those without blocks are left out.
        tiles: key metrics at the top, each with its label.
        last: folded tables after the sections.
    """
    shown = [section for section in sections if section.blocks]
    script = _part("scene.js") if any(map(_has_scene, shown)) else ""
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    policy += f"; script-src 'sha256-{allowed}'" if script else ""
    numbers = count(1)
    parts = "\n".join(_section(section, next(numbers)) for section in shown)
    links = "".join(
        f'<a href="#part{number}">{escape(section.heading)}</a>'
        for number, section in enumerate(shown, 1)
    )
    end = ""
    if last is not None:
        links += f'<a href="#last">{escape(last.heading)}</a>'
        end = (
            f'\n<section id="last"><h2>{escape(last.heading)}</h2>\n{_folded_html(last)}</section>'
        )
    marks = "".join(
        f"<div><b>{escape(value)}</b><span>{escape(what)}</span></div>" for value, what in tiles
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_part('report.css')}</style>\n</head>\n<body>\n"
        f"<header><div><h1>{escape(title)}</h1><p>{escape(about)}</p>"
        f'<div class="tiles">{marks}</div></div></header>\n'
        f'<nav aria-label="Parts of this page"><div>{links}</div></nav>\n'
        f"<main>\n{parts}{end}\n</main>\n"
        + (f"<script>{script}</script>\n" if script else "")
        + "</body>\n</html>\n"
    )


def _part(name: str) -> str:
    """Return the text of a page resource."""
    return (files("worldpose.reports") / "page" / name).read_text(encoding="utf-8")


def _has_scene(section: Section) -> bool:
    return any(isinstance(block, Scene) for block in section.blocks)


def _section(section: Section, number: int) -> str:
    lead = f'<p class="lead">{escape(section.lead)}</p>\n' if section.lead else ""
    blocks = "\n".join(map(_block, section.blocks))
    return (
        f'<section id="part{number}"><h2>{escape(section.heading)}</h2>\n{lead}{blocks}</section>'
    )


def _block(block: CaptionedImage | Table | Scene) -> str:
    if isinstance(block, Scene):
        return scene_html(block)
    if isinstance(block, CaptionedImage):
        return _figure(block)
    heading = f"<h3>{escape(block.heading)}</h3>\n" if block.heading else ""
    return heading + _table(block.columns, block.rows)


def _folded_html(last: Folded) -> str:
    return "\n".join(
        f"<details{' open' if table is last.tables[0] else ''}><summary>{escape(table.heading)}"
        f"</summary>{_table(table.columns, table.rows)}</details>"
        for table in last.tables
        if table.rows
    )


def _figure(picture: CaptionedImage) -> str:
    kind, content, (width, height) = compress_image(picture.png)
    data = base64.b64encode(content).decode("ascii")
    caption = escape(picture.caption)
    return (
        f'<figure><img alt="{caption}" width="{width}" height="{height}" decoding="async" '
        f'src="data:image/{kind};base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain text; the prefix ">" marks numeric columns."""
    kinds = [' class="number"' if column.startswith(">") else "" for column in columns]
    lines = []
    if any(columns):
        cells = (
            f"<th{kind}>{escape(column.removeprefix('>'))}</th>"
            for kind, column in zip(kinds, columns, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    for row in rows:
        cells = (
            f'<td class="bad">{escape(cell)}</td>'
            if isinstance(cell, Failure)
            else f"<td{kind}>{escape(cell)}</td>"
            for kind, cell in zip(kinds, row, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return '<div class="table"><table>\n' + "\n".join(lines) + "\n</table></div>"


LARGE: Final = 200_000
"""Size of a PNG [byte] from which it counts as a photograph, not a plot."""
QUALITY: Final = 88
"""WebP quality that keeps lines of one pixel sharp."""


def compress_image(png: bytes) -> tuple[str, bytes, tuple[int, int]]:
    """Return kind, content and size (width, height) [px] of an image: WebP if it is smaller.

    Args:
        png: a PNG.
    """
    size = (int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big"))
    if len(png) < LARGE:
        return "png", png, size
    import cv2  # late: pages without large images do not need it

    picture = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    _, webp = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return ("webp", webp.tobytes(), size) if webp.size < len(png) else ("png", png, size)
