"""The paper's camera Lambda = (K, R, t, k) as tensors, and its projection Pi (section "Notations").

Derivatives are those of torch. K has one focal length: pixels keep the shape that they had.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from data_contracts.arrays import Integers
from worldpose.body.differentiable import rotation_matrices
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import Rigid

PARAMETERS: Final = 12
"""Of one camera: rotation vector from the start in the camera's axes [rad], centre [m], world,
logarithm of the focal length, principal point [1000 px], k1, k2, k3."""
K1_K2: Final = tuple(range(11))
"""The parameters of a static camera: "we only estimate the k1 and k2 distortion coefficients"."""


@dataclass(frozen=True, eq=False)
class TensorCameras:
    """Cameras as tensors.

    Attributes:
        values: (cameras, 12), see `PARAMETERS`.
        rotation: (cameras, 3, 3), rotation at the start.
        aspect: (cameras,), height over width of the focal length [1].
        image_size: (cameras, 2) [px].
    """

    values: Tensor
    rotation: Tensor
    aspect: Tensor
    image_size: Integers

    @classmethod
    def of(cls, camera: Camera) -> TensorCameras:
        """Return a batch (cameras,) as tensors; NaN where a camera is missing.

        InputError if a lens has more than k1, k2 and k3.
        """
        require_radial(camera)
        parts = [
            np.zeros_like(camera.center),
            camera.center,
            np.log(camera.focal[:, :1]),
            camera.principal_point / 1e3,
            camera.distortion[:, (0, 1, 4)],
        ]
        return cls(
            torch.tensor(np.concatenate(parts, axis=-1)),
            torch.tensor(camera.cam_from_world.rotation),
            torch.tensor(camera.focal[:, 1] / camera.focal[:, 0]),
            camera.image_size,
        )

    def with_values(self, values: Tensor) -> TensorCameras:
        """Return cameras with other parameters."""
        return replace(self, values=values)

    def camera(self) -> Camera:
        """Return the batch (cameras,)."""
        values = self.values.detach()
        rotation = (rotation_matrices(values[:, :3]) @ self.rotation).numpy()
        focal = values[:, 6].exp()
        distortion = np.zeros((len(values), 5))
        distortion[:, (0, 1, 4)] = values[:, 9:].numpy()
        return Camera(
            focal=torch.stack([focal, focal * self.aspect], dim=-1).numpy(),
            principal_point=1e3 * values[:, 7:9].numpy(),
            distortion=distortion,
            cam_from_world=Rigid(
                rotation, -np.einsum("cab,cb->ca", rotation, values[:, 3:6].numpy())
            ),
            image_size=self.image_size,
        )

    def project(self, points: Tensor, of: Tensor | slice = slice(None)) -> Tensor:
        """Return the pixels of points (..., 3) [m] in cameras, which broadcast."""
        return project(points, self.values[of], self.rotation[of], self.aspect[of])


def require_radial(camera: Camera) -> None:
    """Raise InputError if a lens in a batch (cameras,) has more than k1, k2 and k3."""
    brown = np.asarray(camera.lens_model == LensModel.BROWN)
    if not brown.all() or np.nan_to_num(camera.distortion[:, (2, 3, 5, 6, 7)]).any():
        raise InputError(
            "method=paper",
            expected="lenses with k1, k2 and k3 alone, as the paper's",
            found="tangential or other coefficients",
            todo="Use method=worldpose for this camera.",
        )


def project(points: Tensor, values: Tensor, rotation: Tensor, aspect: Tensor) -> Tensor:
    """Return Pi(X; Lambda) (..., 2) [px], the perspective projection with radial distortion.

    x_cam = R (X - C); (x, y) = x_cam / z; s = x^2 + y^2; pixel = f (1 + k1 s + k2 s^2 + k3 s^3) (x,
    y) + c. Section "Static Camera Calibration", Stage 2, and section "Notations".

    X are (..., 3) [m], world, Lambda (..., 12) of `PARAMETERS`; the rotation (..., 3, 3) is that at
    the start, the aspect (...). Behind the camera, pixels are NaN.
    """
    turned = rotation_matrices(values[..., :3]) @ rotation
    local = (turned @ (points - values[..., 3:6])[..., None])[..., 0]
    depth = torch.where(local[..., 2:] > 0.0, local[..., 2:], torch.nan)
    plane = local[..., :2] / depth
    squared = plane.square().sum(-1, keepdim=True)
    k1, k2, k3 = (values[..., i, None] for i in (9, 10, 11))
    bent = plane * (1.0 + k1 * squared + k2 * squared**2 + k3 * squared**3)
    focal = values[..., 6].exp()
    scale: Tensor = torch.stack([focal, focal * aspect], dim=-1)
    return bent * scale + 1e3 * values[..., 7:9]
