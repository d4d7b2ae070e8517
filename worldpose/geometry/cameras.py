"""Pinhole cameras with lens distortion: projection with Jacobians, unprojection, storage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Floats, Image, Integers
from data_contracts.cameras import CameraCalibration, LensCalibration, Vector3
from worldpose.errors import InputError
from worldpose.geometry import camera_model
from worldpose.geometry.lens_models import WIDTH, LensModel, lens_rows
from worldpose.geometry.rays import Rays
from worldpose.geometry.rigid import (
    Index,
    Rigid,
    check_shape,
    common_batch,
    index_leading,
    nearest_rotation,
)

_PARTS = {"focal": 2, "principal_point": 2, "distortion": 8, "image_size": 2}
"""Numbers of the fields of a camera besides its pose and its lens model."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Pixels of world points and their derivatives; all are NaN where `status` is not OK."""

    points_image: Floats
    """(..., n, 2) [px]."""
    d_points: Floats
    """(..., n, 2, 3) [px/m], by the world point."""
    d_pose: Floats
    """(..., n, 2, 6) [px/rad, px/m], by the delta of `cam_from_world.retract(delta)`: rotation
    vector, then translation, both acting in the camera frame."""
    d_intrinsics: Floats
    """(..., n, 2, 4), by fx fy cx cy."""
    d_distortion: Floats
    """(..., n, 2, 8) [px], by k1 k2 p1 p2 k3 k4 k5 k6."""
    status: Image
    """(..., n) RayStatus."""


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole camera with a distorting lens, or a batch of them.

    Batch dimensions of the fields broadcast against each other. A camera with a NaN is missing: its
    pixels and rays are NaN.

    Raises:
        InputError: a field has the wrong shape, or the batches do not broadcast.
    """

    focal: Floats
    """(..., 2) fx, fy [px]."""
    principal_point: Floats
    """(..., 2) cx, cy [px]; (0, 0) is the centre of the top-left pixel."""
    distortion: Floats
    """(..., 8) k1 k2 p1 p2 k3 k4 k5 k6; a coefficient that a lens model lacks is 0. The constructor
    appends zeros to Brown's five."""
    cam_from_world: Rigid
    """(...) pose."""
    image_size: Integers
    """(..., 2) width, height [px]."""
    lens_model: Integers | LensModel = LensModel.BROWN
    """(...) LensModel."""

    def __post_init__(self) -> None:
        pose, lens = self.cam_from_world, np.asarray(self.distortion, dtype=np.float64)
        if lens.shape[-1:] == (5,):
            lens = np.concatenate([lens, np.zeros((*lens.shape[:-1], 3))], axis=-1)
        parts = {
            name: check_shape(
                f"Camera.{name}", lens if name == "distortion" else getattr(self, name), (length,)
            )
            for name, length in _PARTS.items()
        }
        models = np.asarray(self.lens_model, dtype=np.int64)
        batch = common_batch(
            "Camera", pose.batch_shape, models.shape, *(part.shape[:-1] for part in parts.values())
        )
        parts["image_size"] = parts["image_size"].astype(np.int64)
        for name, part in parts.items():
            object.__setattr__(self, name, np.broadcast_to(part, (*batch, part.shape[-1])))
        object.__setattr__(self, "lens_model", np.broadcast_to(models, batch))
        if pose.batch_shape != batch:
            rotation = np.broadcast_to(pose.rotation, (*batch, 3, 3))
            object.__setattr__(self, "cam_from_world", Rigid(rotation, pose.translation))

    @classmethod
    def batch(cls, cameras: Cameras) -> Camera:
        """Return the batch (cameras,) of cameras in any form.

        Raises:
            InputError: there are no cameras, or their batch shapes differ.
        """
        if isinstance(cameras, Camera):
            return cameras
        return cls.stack(list(cameras.values() if isinstance(cameras, Mapping) else cameras))

    @classmethod
    def stack(cls, cameras: Sequence[Camera]) -> Camera:
        """Return one batch of cameras, stacked along a new first dimension.

        Raises:
            InputError: there are no cameras, or their batch shapes differ.
        """
        shapes = [camera.batch_shape for camera in cameras]
        if len(set(shapes)) != 1:
            raise InputError(
                "Camera.stack",
                expected="one or more cameras of one batch shape",
                found=f"batch shapes {shapes}",
                todo="Stack single cameras.",
            )
        poses = [camera.cam_from_world for camera in cameras]
        return cls(
            **{name: np.stack([getattr(camera, name) for camera in cameras]) for name in _PARTS},
            cam_from_world=Rigid(
                np.stack([pose.rotation for pose in poses]),
                np.stack([pose.translation for pose in poses]),
            ),
            lens_model=np.stack([camera.lens_model for camera in cameras]),
        )

    @classmethod
    def from_matrices(
        cls,
        matrix: ArrayLike,
        distortion: ArrayLike,
        rotation: ArrayLike,
        translation: ArrayLike,
        image_size: ArrayLike,
        lens_model: LensModel = LensModel.BROWN,
    ) -> Camera:
        """Return the cameras of OpenCV's matrices; batch dimensions `...` broadcast.

        Args:
            matrix: (..., 3, 3), `K` [px], without skew.
            distortion: (..., 5) k1 k2 p1 p2 k3; (..., 8) with k4 k5 k6 of the rational model; or
                (..., 4) k1 k2 k3 k4 of the fisheye.
            rotation: (..., 3, 3) rotation of `x_cam = rotation x_world + translation`.
            translation: (..., 3) [m].
            image_size: (..., 2) width, height [px].
            lens_model: model of all lenses.

        Raises:
            InputError: an array has the wrong shape, K has a skew or another last row than (0, 0,
                1), a focal length or an image size is not positive, or a rotation is not
                orthonormal with determinant 1 within six decimals.
        """
        k = check_shape("Camera.from_matrices: matrix", matrix, (3, 3))
        known = np.isfinite(k).all(axis=(-2, -1))
        if np.any(k[known][:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] != [0.0, 0.0, 0.0, 0.0, 1.0]):
            raise InputError(
                "Camera.from_matrices: matrix",
                expected="fx 0 cx, 0 fy cy, 0 0 1",
                found=f"{k.tolist()}",
                todo="Give K without skew, not transposed.",
            )
        if not isinstance(lens_model, LensModel):
            named, todo = "Camera.from_matrices: lens_model", "Take LensModel.FISHEYE, for example."
            raise InputError(named, "a LensModel", repr(lens_model), todo)
        sizes = check_shape("Camera.from_matrices: image_size", image_size, (2,))
        whole = (sizes > 0).all() and (sizes % 1.0 == 0.0).all()
        if np.any(np.diagonal(k[known], axis1=-2, axis2=-1) <= 0.0) or not whole:
            raise InputError(
                "Camera.from_matrices",
                expected="positive focal lengths and a positive, whole image size",
                found=f"matrix {k.tolist()}, image_size {sizes.tolist()}",
                todo="Give K in pixels, and width and height of the image.",
            )
        where = "Camera.from_matrices: rotation"
        given = check_shape(where, rotation, (3, 3))
        exact = [
            each if np.isnan(each).any() else nearest_rotation(where, each)
            for each in given.reshape(-1, 3, 3)
        ]
        pose = Rigid(np.reshape(exact, given.shape), np.asarray(translation, dtype=np.float64))
        return cls(
            focal=np.stack([k[..., 0, 0], k[..., 1, 1]], axis=-1),
            principal_point=k[..., :2, 2],
            distortion=_spread_coefficients("Camera.from_matrices", distortion, lens_model),
            cam_from_world=pose,
            image_size=sizes.astype(np.int64),
            lens_model=lens_model,
        )

    @classmethod
    def from_calibration(cls, calibration: CameraCalibration, where: str | None = None) -> Camera:
        """Return the camera of a record, its rotation replaced by the nearest exact one.

        Args:
            calibration: the record.
            where: its place, for messages; None = the camera's id.

        Raises:
            InputError: a focal length or the image size is not positive, the rotation is not
                orthonormal with determinant 1 within what six decimals allow, or the lens folds
                in the middle of the image (`require_rays`).
        """
        where = f"camera {calibration.id}" if where is None else where
        if min(*calibration.focal_px, *calibration.image_size) <= 0:
            raise InputError(
                where,
                expected="positive focal lengths and image size",
                found=f"focal_px {calibration.focal_px}, image_size {calibration.image_size}",
                todo="Correct the calibration.",
            )
        rotation = nearest_rotation(f"{where}: rotation", calibration.rotation)
        model = LensModel.named(calibration.lens_model)
        camera = cls(
            focal=np.array(calibration.focal_px),
            principal_point=np.array(calibration.principal_point_px),
            distortion=_spread_coefficients(where, calibration.distortion, model),
            cam_from_world=Rigid(rotation, np.array(calibration.translation)),
            image_size=np.array(calibration.image_size, dtype=np.int64),
            lens_model=model,
        )
        camera.require_rays(where)
        return camera

    @classmethod
    def from_lens(cls, lens: LensCalibration, image_size: ArrayLike | None = None) -> Camera:
        """Return a camera with a lens, at the origin, for images of its size.

        Raises:
            InputError: the images have another size (width, height) [px].
        """
        if image_size is not None and tuple(np.asarray(image_size)) != lens.image_size:
            width, height = np.asarray(image_size)
            raise InputError(
                f"lens {lens.id}",
                expected=f"image_size {width} x {height}, that of the image",
                found=f"{lens.image_size[0]} x {lens.image_size[1]}",
                todo="Calibrate the lens in images of this size, or scale its numbers of pixels.",
            )
        model = LensModel.named(lens.lens_model)
        return cls(
            focal=np.array([lens.focal_px, lens.focal_px]),
            principal_point=np.array(lens.principal_point_px),
            distortion=_spread_coefficients(f"lens {lens.id}", lens.distortion, model),
            cam_from_world=Rigid.identity(),
            image_size=np.array(lens.image_size),
            lens_model=model,
        )

    @classmethod
    def from_numbers(cls, row: Floats, image_size: ArrayLike) -> Camera:
        """Return the camera of a row (WIDTH,), its rotation replaced by the nearest exact one."""
        u, _, v = np.linalg.svd(row[9:18].reshape(3, 3))
        return cls(
            focal=row[:2],
            principal_point=row[2:4],
            distortion=row[[4, 5, 6, 7, 8, 22, 23, 24]],
            cam_from_world=Rigid(u @ v, row[18:21]),
            image_size=np.asarray(image_size),
            lens_model=LensModel(int(row[25])),
        )

    def to_calibration(self, camera_id: str) -> CameraCalibration:
        """Return the record of a single camera.

        Raises:
            InputError: this is a batch.
        """
        if self.batch_shape:
            raise InputError(
                "Camera.to_calibration",
                expected="a single camera",
                found=f"a batch of shape {self.batch_shape}",
                todo="Index the batch first.",
            )
        width, height = (int(n) for n in self.image_size)
        fx, fy = self.focal.tolist()
        cx, cy = self.principal_point.tolist()
        rows = tuple(_vector3(row) for row in self.cam_from_world.rotation)
        return CameraCalibration(
            id=camera_id,
            image_size=(width, height),
            focal_px=(fx, fy),
            principal_point_px=(cx, cy),
            distortion=tuple(self.coefficients.tolist()),
            lens_model=LensModel(int(self.lens_model)).label,
            rotation=(rows[0], rows[1], rows[2]),
            translation=_vector3(self.cam_from_world.translation),
        )

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch; () for a single camera."""
        return self.focal.shape[:-1]

    @property
    def coefficients(self) -> Floats:
        """Coefficients (n,) of a single camera's lens model, in OpenCV's order."""
        return self.distortion[LensModel(int(self.lens_model)).columns]

    @property
    def center(self) -> Floats:
        """Camera centres (..., 3) [m], world."""
        return self.cam_from_world.inverse().translation

    @property
    def numbers(self) -> Floats:
        """Rows (..., WIDTH) as the kernels of `worldpose.geometry.camera_model` take them."""
        rows = lens_rows(self.distortion, self.lens_model)
        rows[..., :2] = self.focal
        rows[..., 2:4] = self.principal_point
        rows[..., 9:18] = self.cam_from_world.rotation.reshape(*self.batch_shape, 9)
        rows[..., 18:21] = self.cam_from_world.translation
        return rows

    def __getitem__(self, index: Index) -> Camera:
        return Camera(
            **{name: getattr(self, name)[index_leading(index, 1)] for name in _PARTS},
            cam_from_world=self.cam_from_world[index],
            lens_model=np.asarray(self.lens_model)[index],
        )

    def project(self, points_world: ArrayLike) -> Floats:
        """Return the pixels of world points.

        Args:
            points_world: (..., n, 3) [m]; the cameras broadcast against the dimensions before n,
                so that cameras (C,) and points (n, 3) give (C, n, 2).

        Returns:
            (..., n, 2) [px], also outside the image; NaN behind the camera, and where the lens
            model is not one to one.

        Raises:
            InputError: the shapes do not agree.
        """
        batch, cameras, points = self._flat("Camera.project: points_world", points_world, 3)
        image = np.empty((*points.shape[:-1], 2))
        camera_model.project(cameras, points, image)
        return image.reshape((*batch, *image.shape[1:]))

    def project_with_jacobians(self, points_world: ArrayLike) -> Projection:
        """Return the pixels of world points with their derivatives.

        Args:
            points_world: (..., n, 3) [m], as in `project`.

        Raises:
            InputError: the shapes do not agree.
        """
        batch, cameras, points = self._flat(
            "Camera.project_with_jacobians: points_world", points_world, 3
        )
        shape = points.shape[:-1]
        image = np.empty((*shape, 2))
        jacobian = np.empty((*shape, 2, camera_model.DERIVATIVES))
        status = np.empty(shape, dtype=np.uint8)
        camera_model.project_with_jacobians(cameras, points, image, jacobian, status)
        jacobian = jacobian.reshape((*batch, *jacobian.shape[1:]))
        return Projection(
            points_image=image.reshape((*batch, *image.shape[1:])),
            d_points=jacobian[..., :3],
            d_pose=jacobian[..., 3:9],
            d_intrinsics=jacobian[..., 9:13],
            d_distortion=jacobian[..., 13:],
            status=status.reshape((*batch, *status.shape[1:])),
        )

    def unproject(self, points_image: ArrayLike) -> Rays:
        """Return the rays (..., n) of image points (..., n, 2) [px].

        Points broadcast as in `project`; rays without an inverse of the lens model are NaN, with
        a status.

        Raises:
            InputError: the shapes do not agree.
        """
        batch, cameras, points = self._flat("Camera.unproject: points_image", points_image, 2)
        plane, status = _normalize(cameras, points)
        directions = np.empty((*points.shape[:-1], 3))
        camera_model.point_rays(cameras, plane, directions)
        return Rays(
            origins=self.center[..., None, :],
            directions=directions.reshape((*batch, *directions.shape[1:])),
            status=status.reshape((*batch, *status.shape[1:])),
        )

    def normalize(self, points_image: ArrayLike) -> Floats:
        """Return the undistorted coordinates (..., n, 2) of image points [px] on the plane z = 1.

        They are NaN where the lens model has no inverse; shapes are as in `unproject`.

        Raises:
            InputError: the shapes do not agree.
        """
        batch, cameras, points = self._flat("Camera.normalize: points_image", points_image, 2)
        plane, _ = _normalize(cameras, points)
        return plane.reshape((*batch, *plane.shape[1:]))

    def image_grid(self) -> Floats:
        """Return 41 by 41 pixels (1681, 2) over a single camera's image, with its border."""
        width, height = (np.linspace(-0.5, length - 0.5, 41) for length in self.image_size)
        return np.stack(np.meshgrid(width, height), axis=-1).reshape(-1, 2)

    def blind_share(self) -> float:
        """Return the share of a single camera's image without rays: its lens folds before it."""
        # The image of a fisheye may be a circle with black around it.
        if not np.isfinite(self.numbers[21]) or self.lens_model == LensModel.FISHEYE:
            return 0.0
        return float(np.isnan(self.normalize(self.image_grid())[:, 0]).mean())

    def describe_fold(self, where: str) -> str:
        """Return a warning of a single camera whose lens folds within the image, else nothing."""
        share = self.blind_share()
        said = f"{where}: the lens model folds within the image: {share:.0%} of it has no ray"
        return said if share >= 0.01 else ""  # a corner or two hide nobody

    def require_rays(self, where: str) -> None:
        """Raise InputError if a single camera's lens folds in the middle of the image.

        There two directions have one pixel, or a pixel has none: no lens does so, but a polynomial
        does, far from the points to which it was fitted.
        """
        # Share of the image without rays: a third is usual where boards stayed in the middle [1].
        most = 0.5
        if (share := self.blind_share()) > most:
            raise InputError(
                f"{where}: distortion",
                expected="a lens whose image radii grow up to the corners of the image",
                found=f"{self.coefficients.tolist()}, by which {share:.0%} of the image has no "
                "direction or two",
                todo="Calibrate again with boards up to the corners, or with fewer coefficients "
                "(k3 = 0), or with a fisheye's.",
            )

    def _flat(
        self, where: str, points: ArrayLike, width: int
    ) -> tuple[tuple[int, ...], Floats, Floats]:
        """Return the common batch shape, cameras (batch, WIDTH) and points (batch, n, width)."""
        values = check_shape(where, points, (-1, width))
        batch = common_batch(where, self.batch_shape, values.shape[:-2])
        size = int(np.prod(batch))
        cameras = np.broadcast_to(self.numbers, (*batch, WIDTH)).reshape(size, WIDTH)
        shape = values.shape[-2:]
        return batch, cameras, np.broadcast_to(values, (*batch, *shape)).reshape((size, *shape))


def _normalize(cameras: Floats, points: Floats) -> tuple[Floats, Image]:
    """Return undistorted coordinates (batch, n, 2) and their status (batch, n)."""
    plane = np.empty(points.shape)
    status = np.empty(points.shape[:-1], dtype=np.uint8)
    camera_model.normalize(cameras, points, plane, status)
    return plane, status


def _spread_coefficients(where: str, given: ArrayLike, model: LensModel) -> Floats:
    """Return coefficients (..., 8) as `Camera` has them from a model's own in OpenCV's order."""
    name = f"{where}: distortion of lens_model {model.label}"
    values = check_shape(name, given, (len(model.columns),))
    spread = np.zeros((*values.shape[:-1], _PARTS["distortion"]))
    spread[..., model.columns] = values
    return spread


def _vector3(values: Floats) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


def camera_arrays(camera: Camera) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of cameras, by name."""
    pose = camera.cam_from_world
    parts = {name: getattr(camera, name) for name in _PARTS}
    parts["lens_model"] = np.asarray(camera.lens_model).astype(np.uint8)
    return {**parts, "rotation": pose.rotation, "translation": pose.translation}


def camera_from_arrays(arrays: Mapping[Any, ArrayLike]) -> Camera:
    """Return the cameras of stored arrays, bit for bit those that were stored.

    Moving cameras have no array `lens_model`: their model is Brown's.
    """
    parts: dict[str, Any] = {name: np.asarray(arrays[name]) for name in _PARTS}
    parts["lens_model"] = np.asarray(arrays.get("lens_model", LensModel.BROWN))
    rotation, translation = (np.asarray(arrays[name]) for name in ("rotation", "translation"))
    return Camera(**parts, cam_from_world=Rigid(rotation, translation))


Cameras = Camera | Sequence[Camera] | Mapping[str, Camera]
"""Cameras of a rig: a batch (cameras,), each camera, or those of `read_cameras`."""
