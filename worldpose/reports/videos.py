"""Frames of videos: markings and people over a camera's video, and the pitch from above."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Integers
from data_contracts.conventions import COCO17_BONES
from data_contracts.pitch import PitchSpec
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.tables import Positions
from worldpose.geometry.cameras import Camera
from worldpose.reports.bodies import BodyTracks, paint_bodies, zoom_camera
from worldpose.reports.drawing import GRASS, INK, LINE, TEMPLATE, markings, person_color, rgb

PIXELS_PER_M: Final = 10.0
"""Scale of the pitch from above [px/m]."""
MARGIN_M: Final = 5.0
"""Ground around the pitch [m]."""


def overlay_frames(
    pictures: Iterable[Image],
    camera: Camera,
    tracks: JointTracks,
    frames: Integers,
    pitch: PitchSpec | None = None,
    bodies: BodyTracks | None = None,
) -> Iterator[Image]:
    """Yield frames at half size with projected markings and people.

    There is one image (height, width, 3) RGB, and one camera of a batch, per match frame; people
    are drawn in frames of `tracks`, and as surfaces instead of bones if they have bodies.
    """
    lines = markings(pitch) if pitch is not None else []
    rows = {int(frame): row for row, frame in enumerate(tracks.frames)}
    for place, (frame, picture) in enumerate(zip(frames, pictures, strict=True)):
        small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        # Video encoding requires even sides.
        even = small[: small.shape[0] & ~1, : small.shape[1] & ~1]
        canvas = np.asarray(even, dtype=np.uint8, order="C")
        half = zoom_camera(camera[place], np.full(2, -0.5), 0.5, (canvas.shape[1], canvas.shape[0]))
        for line in lines:
            _draw(canvas, half.project(line), rgb(TEMPLATE))
        if frame in rows:
            joints = tracks.joints[rows[frame]]
            drawn = _paint(canvas, half, joints, tracks.person_ids, int(frame), bodies)
            for person_id, own in zip(tracks.person_ids, joints, strict=True):
                if int(person_id) not in drawn:
                    pixels = half.project(own)
                    for bone in COCO17_BONES:
                        _draw(canvas, pixels[list(bone)], rgb(person_color(int(person_id))))
        yield np.asarray(canvas, dtype=np.uint8)


def _paint(
    canvas: Image,
    camera: Camera,
    joints: Floats,
    person_ids: NDArray[np.integer],
    frame: int,
    bodies: BodyTracks | None,
) -> set[int]:
    """Draw the bodies in the image, and return the ids of all people with bodies."""
    opacity = 0.6  # opacity of bodies [1]: the player in the image stays visible for comparison
    if bodies is None or frame not in bodies.frames:
        return set()
    poses = bodies.poses[int(np.searchsorted(bodies.frames, frame))]
    embodied = set(bodies.person_ids[np.isfinite(poses.transl).all(axis=-1)].tolist())
    size = np.asarray(camera.image_size)
    pixels = camera.project(joints)
    margin = 0.1  # around the image within which joints are visible, in image widths [1]
    with np.errstate(invalid="ignore"):
        near = (pixels > -margin * size[0]) & (pixels < size + margin * size[0])
    seen = embodied & set(person_ids[near.all(axis=-1).any(axis=-1)].tolist())
    who = np.flatnonzero(np.isin(bodies.person_ids, list(seen)))
    if len(who):
        colors = np.array([rgb(person_color(int(n))) for n in bodies.person_ids[who]]) / 255.0
        surfaces = bodies.model.vertices(poses[who])
        paint_bodies(canvas, camera, surfaces, bodies.model.faces, colors, opacity=opacity)
    return embodied


def _draw(canvas: Image, pixels: Floats, color: tuple[int, int, int]) -> None:
    """Draw the finite parts of a polyline (n, 2) [px]."""
    far = 4.0  # maximum absolute coordinate of drawn points, in image widths [1]
    with np.errstate(invalid="ignore"):
        near = (np.abs(pixels) < far * canvas.shape[1]).all(axis=-1)
    begins = np.flatnonzero(near & ~np.append(False, near[:-1]))
    ends = np.flatnonzero(near & ~np.append(near[1:], False)) + 1
    steps_per_pixel = 16  # of line coordinates
    for begin, end in zip(begins, ends, strict=True):
        whole = np.rint(steps_per_pixel * pixels[begin:end]).astype(np.int32)
        shift = steps_per_pixel.bit_length() - 1
        cv2.polylines(canvas, [whole], False, color, 1, cv2.LINE_AA, shift)


def minimap_frames(positions: Positions, pitch: PitchSpec) -> Iterator[Image]:
    """Yield the pitch from above, an image (height, width, 3) RGB per frame of `positions`.

    A disc is a triangulated person, a ring one placed by the feet alone; the label is the roster
    id, or else the person's number. Images have even sides.
    """
    radius_px = 8  # radius of a person's disc on the pitch from above [px]
    half = 0.5 * np.array([pitch.length, pitch.width]) + MARGIN_M
    width, height = (2.0 * np.rint(half * PIXELS_PER_M)).astype(int).tolist()

    def locate(xy: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
        pixels = np.stack([xy[..., 0] + half[0], half[1] - xy[..., 1]], axis=-1) * PIXELS_PER_M
        return np.rint(pixels).astype(np.int32)

    ground = np.full((height, width, 3), rgb(GRASS), dtype=np.uint8)
    for line in markings(pitch):
        cv2.polylines(ground, [locate(line[:, :2])], False, rgb(LINE), 2, cv2.LINE_AA)
    legend = "disc: triangulated, ring: by the feet"
    for row, frame in enumerate(positions.frames.tolist()):
        canvas = ground.copy()
        _write(canvas, f"frame {frame}   {legend}", (10, 24), INK)
        for p in np.flatnonzero(np.isfinite(positions.xy[row, :, 0])).tolist():
            person = int(positions.person[p])
            x, y = locate(positions.xy[row, p]).tolist()
            thickness = 2 if positions.on_plane[row, p] else cv2.FILLED
            color = person_color(person)
            cv2.circle(canvas, (x, y), radius_px, rgb(color), thickness, cv2.LINE_AA)
            _write(canvas, positions.names[p] or str(person), (x + 10, y - 6), color)
        yield canvas


def _write(canvas: Image, text: str, place: tuple[int, int], color: str) -> None:
    """Write a label."""
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, rgb(color), 1, cv2.LINE_AA)
