"""USD file (.usdc) of a clip: skinned bodies that move, cameras and the pitch (extra `usd`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from data_contracts.arrays import Floats
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyModel
from worldpose.errors import UsageError
from worldpose.formats.files import whole_file
from worldpose.formats.gltf_file import (
    FACING,
    INFLUENCES,
    AnimatedBody,
    known_frames,
    lens_notes,
    people_with_bodies,
    rest_joints,
    skin_weights,
)
from worldpose.geometry.cameras import Camera


def write_usd(
    path: Path,
    model: BodyModel,
    people: Sequence[AnimatedBody],
    fps: float,
    *,
    cameras: Mapping[str, Camera],
    markings: Sequence[Floats],
    notes: Mapping[str, str],
    surface: bool = True,
) -> None:
    """Write a clip as one .usdc file, whole or not at all.

    The stage is in metres, z up, as the world is; a time code is a frame. Each person is a SkelRoot
    with a skeleton of 24 joints, its animation, and a mesh with the person's shape and the model's
    skinning weights, without pose correctives. A missing person is invisible. Cameras have focal
    length, principal point and pose, and their distortion as custom data, or as an attribute of the
    same name with time samples where it changes. Arguments and errors are as of `write_gltf`;
    `notes` become the stage's custom data. UsageError if the library is not installed.
    """
    present = people_with_bodies(path, people)
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
    except ImportError as error:
        expected = "worldpose with the extra usd"
        todo = "Install it: pip install 'worldpose[usd]'."
        raise UsageError("--format usd", expected, "no usd-core", todo) from error
    pxr = (Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt)
    with whole_file(path) as draft:
        stage = Usd.Stage.CreateNew(str(draft))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(max(int(person.poses.batch_shape[0]) for person in present) - 1)
        world = UsdGeom.Xform.Define(stage, "/world")
        stage.SetDefaultPrim(world.GetPrim())
        stage.GetRootLayer().customLayerData = dict(notes)
        writer = _Writer(stage, pxr, model)
        for number, person in enumerate(present):
            writer.add_person(person, number, surface=surface)
        for number, line in enumerate(markings):
            writer.add_line(number, line)
        for name, camera in cameras.items():
            writer.add_camera(name, camera)
        stage.GetRootLayer().Save()


class _Writer:
    """Prims of people, cameras and pitch below `/world`."""

    def __init__(self, stage: Any, pxr: tuple[Any, ...], model: BodyModel) -> None:  # noqa: ANN401
        self.stage, self.model = stage, model
        self.Gf, self.Sdf, self.Usd, self.UsdGeom, self.UsdSkel, self.Vt = pxr
        names = SKELETONS["smpl24"]
        self.joints = [names[0]]
        for joint in range(1, len(names)):
            self.joints.append(f"{self.joints[model.parents[joint]]}/{names[joint]}")

    def _matrix(self, place: Floats, rotation: Floats | None = None) -> Any:  # noqa: ANN401
        """Return a matrix for row vectors, as USD has them."""
        matrix = np.eye(4)
        if rotation is not None:
            matrix[:3, :3] = rotation.T
        matrix[3, :3] = place
        return self.Gf.Matrix4d(matrix.tolist())

    def add_person(self, person: AnimatedBody, number: int, *, surface: bool) -> None:
        """Add a person's skeleton, motion and surface."""
        model = self.model
        there = person.poses.known
        rows, poses, rest = rest_joints(model, person)
        place = f"/world/{person.name}"
        root = self.UsdSkel.Root.Define(self.stage, place)
        root.GetPrim().SetCustomData(dict(person.about))
        skeleton = self.UsdSkel.Skeleton.Define(self.stage, f"{place}/skeleton")
        skeleton.CreateJointsAttr(self.joints)
        skeleton.CreateBindTransformsAttr([self._matrix(one) for one in rest])
        parents = model.parents
        local = np.array([rest[j] - rest[parents[j]] if j else rest[0] for j in range(len(rest))])
        skeleton.CreateRestTransformsAttr([self._matrix(one) for one in local])
        motion = self.UsdSkel.Animation.Define(self.stage, f"{place}/motion")
        motion.CreateJointsAttr(self.joints)
        self._animate(motion, rows, local, rest[0] + poses.transl, model.articulate(poses))
        self.UsdSkel.BindingAPI.Apply(root.GetPrim())
        binding = self.UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
        binding.CreateAnimationSourceRel().SetTargets([motion.GetPrim().GetPath()])
        if not there.all():
            seen = self.UsdGeom.Imageable(root.GetPrim()).CreateVisibilityAttr()
            for frame in (0, *(np.flatnonzero(np.diff(there)) + 1).tolist()):
                shown = self.UsdGeom.Tokens.inherited if there[frame] else "invisible"
                seen.Set(shown, int(frame))
        if surface:
            self._add_surface(place, poses.betas[0], number)

    def _animate(
        self,
        motion: Any,  # noqa: ANN401
        rows: np.ndarray[Any, Any],
        local: Floats,
        pelvis: Floats,
        posed: Any,  # noqa: ANN401
    ) -> None:
        """Write translations, rotations and scales of all joints at each frame."""
        shape = posed.local_rotations.shape[:2]
        turns = Rotation.from_matrix(posed.local_rotations.reshape(-1, 3, 3)).as_quat()
        turns = turns.reshape(*shape, 4)[..., [3, 0, 1, 2]].astype(np.float32)
        scales = self.Vt.Vec3hArray([self.Gf.Vec3h(1.0, 1.0, 1.0)] * shape[1])
        motion.CreateScalesAttr(scales)
        translations, rotations = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
        for row, frame in enumerate(rows.tolist()):
            moved = local.astype(np.float32)
            moved[0] = pelvis[row]
            translations.Set(self.Vt.Vec3fArray.FromNumpy(moved), frame)
            quats = [self.Gf.Quatf(*(float(n) for n in quat)) for quat in turns[row]]
            rotations.Set(self.Vt.QuatfArray(quats), frame)

    def _add_surface(self, place: str, betas: Floats, number: int) -> None:
        """Add the mesh of a person in the pose in which the skeleton is bound."""
        model = self.model
        points = (model.template + model.shape_directions @ betas).astype(np.float32)
        mesh = self.UsdGeom.Mesh.Define(self.stage, f"{place}/surface")
        mesh.CreatePointsAttr(self.Vt.Vec3fArray.FromNumpy(points))
        faces = model.faces.astype(np.int32)
        mesh.CreateFaceVertexCountsAttr(
            self.Vt.IntArray.FromNumpy(np.full(len(faces), 3, dtype=np.int32))
        )
        mesh.CreateFaceVertexIndicesAttr(self.Vt.IntArray.FromNumpy(faces.ravel()))
        mesh.CreateSubdivisionSchemeAttr(self.UsdGeom.Tokens.none)
        hue = number * 0.618 % 1.0
        colour = 0.65 + 0.2 * np.cos(2.0 * np.pi * (hue - np.array([0.0, 1.0, 2.0]) / 3.0))
        mesh.CreateDisplayColorAttr([self.Gf.Vec3f(*(float(n) for n in colour))])
        order, weights = skin_weights(model)
        binding = self.UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        binding.CreateSkeletonRel().SetTargets([self.Sdf.Path(f"{place}/skeleton")])
        binding.CreateJointIndicesPrimvar(False, INFLUENCES).Set(
            self.Vt.IntArray.FromNumpy(order.astype(np.int32).ravel())
        )
        binding.CreateJointWeightsPrimvar(False, INFLUENCES).Set(
            self.Vt.FloatArray.FromNumpy(weights.ravel())
        )
        binding.CreateGeomBindTransformAttr(self.Gf.Matrix4d(1.0))

    def add_camera(self, name: str, camera: Camera) -> None:
        """Add a single or a moving camera."""
        aperture_mm = 36.0  # of a sensor's width; only its ratio to the focal length counts
        place, again = f"/world/{_prim_name(name)}", 1
        while self.stage.GetPrimAtPath(place + f"_{again}" * (again > 1)).IsValid():
            again += 1
        prim = self.UsdGeom.Camera.Define(self.stage, place + f"_{again}" * (again > 1))
        prim.GetPrim().SetCustomData({"camera": name})
        rows, known = known_frames(camera)
        if not len(rows):
            return
        width, height = (float(n) for n in known.image_size[0])
        per_pixel = aperture_mm / width
        prim.CreateHorizontalApertureAttr(aperture_mm)
        # Pixels may be oblong: USD has one focal length and two apertures.
        tall = float(np.median(known.focal[:, 0] / known.focal[:, 1]))
        prim.CreateVerticalApertureAttr(per_pixel * height * tall)
        center = (known.principal_point[0] + 0.5 - 0.5 * np.array([width, height])) * per_pixel
        prim.CreateHorizontalApertureOffsetAttr(-float(center[0]))
        prim.CreateVerticalApertureOffsetAttr(float(center[1]) * tall)
        prim.CreateClippingRangeAttr(self.Gf.Vec2f(0.1, 1000.0))
        model, key, lenses = lens_notes(known)
        prim.GetPrim().SetCustomData(
            {
                "camera": name,
                "image_size_px": self.Gf.Vec2i(int(width), int(height)),
                "principal_point_px": self.Gf.Vec2d(*known.principal_point[0].tolist()),
                "lens_model": model,
                **({key: self.Vt.DoubleArray(lenses[0].tolist())} if len(lenses) == 1 else {}),
            }
        )
        if len(lenses) > 1:
            kind = self.Sdf.ValueTypeNames.DoubleArray
            changing = prim.GetPrim().CreateAttribute(key, kind)
            for frame, lens in zip(rows.tolist(), lenses.tolist(), strict=True):
                changing.Set(self.Vt.DoubleArray(lens), frame)
        placed = self.UsdGeom.Xformable(prim).AddTransformOp()
        focal = prim.CreateFocalLengthAttr()
        turns = known.cam_from_world.rotation.swapaxes(-1, -2) @ FACING
        for row, frame in enumerate(rows.tolist()):
            time = frame if camera.batch_shape not in ((), (1,)) else self.Usd.TimeCode.Default()
            placed.Set(self._matrix(known.center[row], turns[row]), time)
            focal.Set(float(known.focal[row, 0]) * per_pixel, time)

    def add_line(self, number: int, line: Floats) -> None:
        """Add a marking of the pitch as a line 0.12 m wide."""
        curve = self.UsdGeom.BasisCurves.Define(self.stage, f"/world/pitch/marking_{number:02d}")
        curve.CreateTypeAttr(self.UsdGeom.Tokens.linear)
        curve.CreatePointsAttr(self.Vt.Vec3fArray.FromNumpy(line.astype(np.float32)))
        curve.CreateCurveVertexCountsAttr([len(line)])
        curve.CreateWidthsAttr([0.12])
        curve.SetWidthsInterpolation(self.UsdGeom.Tokens.constant)


def _prim_name(name: str) -> str:
    """Return a name that USD allows: letters, digits and underscores, not a digit first."""
    allowed = "".join(one if one.isalnum() and one.isascii() else "_" for one in name)
    return f"camera_{allowed}" if not allowed or allowed[0].isdigit() else allowed
