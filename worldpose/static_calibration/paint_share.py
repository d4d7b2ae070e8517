"""Share of the markings that a given camera projects onto paint of its image."""

from __future__ import annotations

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.from_paint.paint import smooth_lightness
from worldpose.static_calibration.line_samples import project_lines, sample_markings, stated_noise


def paint_share(picture: Image, camera: Camera, pitch: PitchTemplate) -> float | None:
    """Return the share of projected markings with a clearer ridge there than on either side [1].

    Ridges are brighter or darker than the ground, whichever are more: halls have dark lines. By
    chance it is a third. A camera that is right has 0.6 and more: people hide the rest. None if the
    image would show too few markings to tell.
    """
    samples = sample_markings(pitch, 0.5)
    seen = project_lines(camera, samples, 0.12, stated_noise(0.01, 1.0))
    places, normals = seen.places[seen.visible], seen.normals[seen.visible]
    if len(places) < 50:
        return None
    width = np.maximum(3.0, seen.widths[seen.visible])[:, None]
    lightness = smooth_lightness(picture)

    def look(offset: Floats) -> Floats:
        at = (places[:, None] + offset[..., None] * normals[:, None]).astype(np.float32)
        found = cv2.remap(lightness, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        return np.asarray(found, dtype=np.float64)

    # A window of 3 px or of the paint's width around the marking, and one on either side of it.
    steps = np.linspace(-1.0, 1.0, 7) * width
    ridges = []
    for side in (-3.0, 0.0, 3.0):
        offset = steps + side * width
        middle, *edges = look(offset), look(offset - 1.5 * width), look(offset + 1.5 * width)
        over = [sign * middle - np.maximum(*(sign * np.array(edges))) for sign in (1.0, -1.0)]
        ridges.append(np.max(over, axis=-1))
    near, here, far = np.array(ridges)  # each (2, places)
    return float((here > np.maximum(np.maximum(near, far), 2.0)).mean(axis=1).max())
