"""Compares two clicks with one label: what the other clicks of the image say."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from worldpose.errors import InputError
from worldpose.evaluation.cameras import surface_points
from worldpose.ingest.annotations import clicked_file, read_clicked_markings
from worldpose.ingest.clicks import RepeatedClick
from worldpose.ingest.match_folder import read_spec
from worldpose.ingest.pitch_file import read_pitch
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera

NAMED_WITHIN_M: Final = 1.0
"""Maximum distance to a point of the pitch at which a place has the point's name [m]."""
MIN_DISTANCE_M: Final = 2.0
"""Minimum distance from its label at which a click is assigned to another place [m]."""
MIN_RATIO: Final = 3.0
"""Minimum ratio of this distance to that of the other click for the assignment [1]."""


def explain_repeated(folder: Path, file: Path, repeated: list[RepeatedClick]) -> list[str]:
    """Return a sentence for each repeated label: both pixels, the wrong one, and what to do.

    The clicks were imported from `file` into the match folder.
    """
    return [
        f"{each.image}: {each.label!r} is clicked at {_pixel(each.pixels[0])} and at "
        f"{_pixel(each.pixels[1])}. Which one is meant? {_judge(folder, each)} Correct "
        f"the label of the wrong one in {file.name}, remove {folder / clicked_file(each.owner)} "
        "and import again; or leave both: calibration excludes a click that the others contradict."
        for each in repeated
    ]


def _pixel(pixel: tuple[float, float]) -> str:
    return f"({pixel[0]:.0f}, {pixel[1]:.0f})"


def _judge(folder: Path, each: RepeatedClick) -> str:
    """Return which of the two clicks the others contradict, and what it shows, as a sentence."""
    undecided = "The other clicks do not decide it."
    spec = read_spec(folder)
    pitch = read_pitch(folder, spec)
    static = {camera.id: camera for camera in spec.static_cameras}
    if pitch is None or each.owner not in static:
        return undecided
    camera, template = static[each.owner], PitchTemplate.from_spec(pitch)
    clicked = read_clicked_markings(folder / clicked_file(each.owner), camera, pitch)
    try:
        found = calibrate_camera(template, clicked, (camera.width, camera.height))
    except InputError:
        return undecided
    rays = found.estimate.camera.unproject(np.array(each.pixels))
    places = surface_points(rays, template)[:, :2]
    off = [float(np.hypot(*(place - template.points[each.names[0]][:2]))) for place in places]
    meant, other = (0, 1) if off[0] <= off[1] else (1, 0)
    if not off[other] > max(MIN_DISTANCE_M, MIN_RATIO * off[meant]):
        return undecided
    near = {
        name: float(np.hypot(*(at[:2] - places[other])))
        for name, at in template.points.items()
        if name not in each.names
    }
    nearest = min(near, key=lambda name: near[name])
    shown = "x {:.1f}, y {:.1f} m of the world".format(*places[other])
    if near[nearest] < NAMED_WITHIN_M:
        shown += f", near {nearest}"
    return (
        f"By the other clicks the one at {_pixel(each.pixels[meant])} is {off[meant]:.1f} m from "
        f"the label's place, and the one at {_pixel(each.pixels[other])} shows {shown}."
    )
