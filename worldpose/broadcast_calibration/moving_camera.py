"""Moving camera: one center and principal point, with a rotation and a lens per frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats, Integers
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import Rigid
from worldpose.static_calibration.parameters import by_step

FRAME_SIZE = 7
"""Parameters of a frame's step: rotation [rad] in the camera's axes, log focal, k1, k2, k3."""
CLIP_SIZE = 5
"""Parameters of the clip's step: center [m], world, and principal point [px]."""


@dataclass(frozen=True, eq=False)
class MovingCamera:
    """A camera that rotates and zooms about a fixed center.

    Attributes:
        center: (3,) [m], world.
        principal_point: (2,) [px].
        rotation: (frames, 3, 3) rotation of x_cam = R (x_world - center).
        focal: (frames,) [px]; square pixels.
        distortion: (frames, 3) k1, k2, k3 of Brown's model.
        image_size: (2,) width, height [px].
    """

    center: Floats
    principal_point: Floats
    rotation: Floats
    focal: Floats
    distortion: Floats
    image_size: Integers

    @classmethod
    def of(cls, camera: Camera, center: ArrayLike, principal_point: ArrayLike) -> MovingCamera:
        """Return a batch (frames,) of this center [m] and principal point [px], with Brown's lens.

        InputError if its lens is not of Brown's model.
        """
        others = set(np.unique(camera.lens_model).tolist()) - {LensModel.BROWN.value}
        if others:
            raise InputError(
                "MovingCamera.of",
                expected=f"lenses of the model {LensModel.BROWN.label}",
                found=", ".join(LensModel(code).label for code in sorted(others)),
                todo="Fit the frames with that model (`fit_brown_lens`).",
            )
        return cls(
            center=np.asarray(center, dtype=np.float64),
            principal_point=np.asarray(principal_point, dtype=np.float64),
            rotation=np.ascontiguousarray(camera.cam_from_world.rotation),
            focal=np.ascontiguousarray(camera.focal.mean(axis=-1)),
            distortion=np.ascontiguousarray(camera.distortion[:, [0, 1, 4]]),
            image_size=camera.image_size[0],
        )

    @classmethod
    def from_batch(cls, camera: Camera) -> MovingCamera:
        """Return a batch (frames,) with one center and principal point as a moving camera."""
        return cls.of(camera, camera.center[0], camera.principal_point[0])

    def __len__(self) -> int:
        return len(self.focal)

    @property
    def camera(self) -> Camera:
        """Batch (frames,) of cameras."""
        distortion = np.zeros((len(self), 5))
        distortion[:, [0, 1, 4]] = self.distortion
        return Camera(
            focal=np.repeat(self.focal[:, None], 2, axis=1),
            principal_point=np.broadcast_to(self.principal_point, (len(self), 2)),
            distortion=distortion,
            cam_from_world=Rigid(self.rotation, -self.rotation @ self.center),
            image_size=self.image_size,
        )

    @property
    def rows(self) -> Floats:
        """Rows (frames, WIDTH) as the kernels of `worldpose.geometry.camera_model` take them."""
        return self.camera.numbers

    def project_with_jacobian(self, frame: int, places: ArrayLike) -> tuple[Floats, Floats]:
        """Return pixels (n, 2) of places (n, 3) [m], world, in a frame, and derivatives (n, 2, 12).

        Derivatives are by the frame's step, then by the clip's; NaN where there is no image.
        """
        camera = self.frames(slice(frame, frame + 1)).camera[0]
        seen = camera.project_with_jacobians(places)
        step = by_step(camera, seen)
        parts = step[..., :3], step[..., [6, 9, 10, 11]], -seen.d_points, step[..., 7:9]
        return seen.points_image, np.concatenate(parts, axis=-1)

    def frames(self, index: Integers | slice) -> MovingCamera:
        """Return some of the frames."""
        return replace(
            self,
            rotation=np.ascontiguousarray(self.rotation[index]),
            focal=np.ascontiguousarray(self.focal[index]),
            distortion=np.ascontiguousarray(self.distortion[index]),
        )

    def take_step(self, frame_step: ArrayLike, clip_step: ArrayLike) -> MovingCamera:
        """Return the camera after a step of the frames (frames, 7) and of the clip (5,)."""
        step = np.asarray(frame_step, dtype=np.float64)
        shared = np.asarray(clip_step, dtype=np.float64)
        turn = Rigid.from_rotvec(step[:, :3], np.zeros(3)).rotation
        return replace(
            self,
            center=self.center + shared[:3],
            principal_point=self.principal_point + shared[3:],
            rotation=turn @ self.rotation,
            focal=self.focal * np.exp(step[:, 3]),
            distortion=self.distortion + step[:, 4:],
        )


def join_cameras(parts: list[MovingCamera]) -> MovingCamera:
    """Return the concatenated frames, with center and principal point of the first part."""
    return replace(
        parts[0],
        rotation=np.concatenate([part.rotation for part in parts]),
        focal=np.concatenate([part.focal for part in parts]),
        distortion=np.concatenate([part.distortion for part in parts]),
    )
