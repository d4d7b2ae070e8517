"""Conversion between a single camera and the arrays of `data_contracts.cameras`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from worldpose.geometry.pinhole import Camera
from worldpose.geometry.rigid import Rigid


def camera_arrays(camera: Camera) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of a single camera, by name."""
    return {
        "focal": camera.focal,
        "principal_point": camera.principal_point,
        "distortion": camera.distortion,
        "rotation": camera.cam_from_world.rotation,
        "translation": camera.cam_from_world.translation,
        "image_size": camera.image_size,
    }


def camera_from_arrays(arrays: Mapping[Any, ArrayLike]) -> Camera:
    """Return the camera of stored arrays, bit for bit the one that was stored."""
    stored = {name: np.asarray(arrays[name]) for name in _NAMES}
    return Camera(
        focal=stored["focal"],
        principal_point=stored["principal_point"],
        distortion=stored["distortion"],
        cam_from_world=Rigid(stored["rotation"], stored["translation"]),
        image_size=stored["image_size"],
    )


_NAMES = ("focal", "principal_point", "distortion", "rotation", "translation", "image_size")
