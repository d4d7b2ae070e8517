"""npz file formats of joints of people over time, and of body poses as in the release."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from data_contracts.conventions import COCO17
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.archives import Member, read_archive, write_archive, wrong

MEMBERS: Final = {
    "frames": Member(("frames",), "int"),
    "person_ids": Member(("persons",), "int"),
    "joints": Member(("frames", "persons", len(COCO17), 3), "float"),
    "covariance": Member(("frames", "persons", len(COCO17), 3, 3), "float", required=False),
    "views": Member(("frames", "persons", len(COCO17)), "int", required=False),
    "source": Member(("frames", "persons", len(COCO17)), "int", required=False),
    "identity_certainty": Member(("frames", "persons"), "float", required=False),
    "points": Member(("points",), "text", required=False),
    "extra_joints": Member(("frames", "persons", "points", 3), "float", required=False),
    "extra_covariance": Member(("frames", "persons", "points", 3, 3), "float", required=False),
    "extra_views": Member(("frames", "persons", "points"), "int", required=False),
}
"""Arrays of a joints file; all but the first three are optional."""
EXTRA_MEMBERS: Final = ("points", "extra_joints", "extra_covariance", "extra_views")
"""Those of points besides COCO-17."""


@dataclass(frozen=True, eq=False)
class ExtraTracks:
    """Points besides COCO-17 of several people over time, such as heels and toes.

    Attributes:
        points: (points,) names, each once and none of COCO-17.
        joints: (frames, persons, points, 3) [m], world; NaN where missing.
        covariance: (frames, persons, points, 3, 3) [m^2]; None if unknown.
        views: (frames, persons, points), as in `JointTracks`; None if unknown.
    """

    points: tuple[str, ...]
    joints: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None
    views: NDArray[np.integer] | None = None


@dataclass(frozen=True, eq=False)
class JointTracks:
    """3D joints of several people over time, estimated or true.

    Raises:
        InputError: shapes disagree, frames do not ascend, a duplicate id, a value is infinite, or a
            joint has some but not all of its coordinates.
    """

    frames: NDArray[np.int64]
    """(frames,) match frames, ascending."""
    person_ids: NDArray[np.integer]
    """(persons,), unique."""
    joints: NDArray[np.float64]
    """(frames, persons, 17, 3) [m], world, COCO-17 order; NaN where missing."""
    covariance: NDArray[np.float64] | None = None
    """(frames, persons, 17, 3, 3) [m^2]; None if unknown."""
    views: NDArray[np.integer] | None = None
    """(frames, persons, 17) number of cameras used for the joint, or that saw it for ground
    truth."""
    extra: ExtraTracks | None = None
    """Points besides COCO-17 of the same frames and persons; None without any."""
    identity_certainty: NDArray[np.float64] | None = None
    """(frames, persons) probability that this is the person of the id's first frame [1]; NaN where
    not stated, None if it is nowhere."""
    source: NDArray[np.integer] | None = None
    """(frames, persons, 17) where a joint comes from: 1 = the views, triangulated; 2 = the fitted
    body, where the detector sees it; 3 = the fitted body, where the model has it; 0 = missing or
    interpolated. None if unknown."""

    @property
    def markers(self) -> ExtraTracks:
        """All points by name, those of COCO-17 first."""
        if self.extra is None:
            return ExtraTracks(COCO17, self.joints, self.covariance, self.views)

        def join(own: NDArray[Any] | None, extra: NDArray[Any] | None, missing: float) -> Any:  # noqa: ANN401
            if own is None or self.extra is None:
                return None
            if extra is None:
                shape = (*own.shape[:2], len(self.extra.points), *own.shape[3:])
                extra = np.full(shape, missing, own.dtype)
            return np.concatenate([own, extra], axis=2)

        return ExtraTracks(
            (*COCO17, *self.extra.points),
            join(self.joints, self.extra.joints, np.nan),
            join(self.covariance, self.extra.covariance, np.nan),
            join(self.views, self.extra.views, 0),
        )

    def __post_init__(self) -> None:
        for name in ("frames", "person_ids", "joints", "covariance", "views"):
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, np.asarray(given))
        for name, kind in (("frames", np.int64), ("person_ids", np.int64), ("views", np.uint8)):
            given, most = getattr(self, name), np.iinfo(kind).max
            counts: NDArray[Any] = np.zeros(0, kind) if given is None else given
            whole = counts.dtype.kind in "biu" or (
                counts.dtype.kind == "f" and (counts == np.floor(counts)).all()
            )
            if not whole or (counts > most).any():
                todo = "Number frames and people, and give times as fps."
                raise wrong(name, f"whole numbers up to {most}", f"{counts.ravel()[:3]}", todo)
        parts = [("", ExtraTracks(COCO17, self.joints, self.covariance, self.views))]
        if self.extra is not None:
            names = self.extra.points
            if len(set(names)) < len(names) or set(names) & set(COCO17):
                todo = "Rename the points."
                raise wrong("points", "each name once, and none of COCO-17", ", ".join(names), todo)
            parts.append(("extra_", self.extra))
        for prefix, part in parts:
            shape = (*self.frames.shape, *self.person_ids.shape, len(part.points))
            for name, array, expected in (
                ("joints", part.joints, (*shape, 3)),
                ("covariance", part.covariance, (*shape, 3, 3)),
                ("views", part.views, shape),
            ):
                if array is not None and array.shape != expected:
                    where, todo = f"{prefix}{name}", "Give all arrays alike."
                    raise wrong(where, f"shape {expected}", f"{array.shape}", todo)
        certainty, size = self.identity_certainty, (len(self.frames), len(self.person_ids))
        if certainty is not None and certainty.shape != size:
            raise wrong("identity_certainty", f"shape {size}", f"{certainty.shape}", "Correct it.")
        if self.source is not None and self.source.shape != self.joints.shape[:-1]:
            found = f"{self.source.shape}"
            raise wrong("source", f"shape {self.joints.shape[:-1]}", found, "Correct it.")
        if certainty is not None and ((certainty < 0.0) | (certainty > 1.0)).any():
            raise wrong("identity_certainty", "0 to 1", f"{np.nanmax(certainty)}", "Correct it.")
        if np.any(np.diff(self.frames) <= 0):
            raise wrong("frames", "frame numbers that rise", f"{self.frames}", "Sort the frames.")
        if len(np.unique(self.person_ids)) < len(self.person_ids):
            raise wrong(
                "person_ids", "each id once", f"{self.person_ids}", "Number the people again."
            )
        for prefix, part in parts:
            self._check_values(prefix, part)

    def _check_values(self, prefix: str, part: ExtraTracks) -> None:
        joints, missing = part.joints, np.isnan(part.joints)
        some = missing.any(axis=-1) & ~missing.all(axis=-1)
        checks: list[tuple[str, NDArray[Any], Any, str]] = [
            ("joints", joints, np.isinf(joints).any(axis=-1), "finite metres, NaN where missing"),
            ("joints", joints, some, "all of x, y, z or none"),
        ]
        if part.covariance is not None:
            infinite = np.isinf(part.covariance).any(axis=(-1, -2))
            checks.append(("covariance", part.covariance, infinite, "finite numbers"))
        if part.views is not None:
            checks.append(("views", part.views, part.views < 0, "counts from 0"))
        for name, array, bad, expected in checks:
            if bad.any():
                frame, person, joint = (int(i) for i in np.argwhere(bad)[0])
                place = f"frame {self.frames[frame]}, person {self.person_ids[person]}"
                where = f"{prefix}{name}[{place}, {part.points[joint]}]"
                raise wrong(where, expected, f"{array[frame, person, joint]}", "Correct it.")


def fill_gaps(tracks: JointTracks) -> JointTracks:
    """Return tracks in which joints that are missing for a while are interpolated.

    Each joint of each person is interpolated between its first and its last frame by monotone
    cubic pieces, which do not overshoot; nothing is extrapolated. `views` is 0 at an interpolated
    joint, as at every joint that no camera contributes to, and its covariance is NaN: the
    error of an interpolated position is unknown. Frames that all people lack are added.
    """
    if not len(tracks.frames):
        return tracks
    frames = np.arange(tracks.frames[0], tracks.frames[-1] + 1)
    rows = tracks.frames - tracks.frames[0]
    markers = tracks.markers
    shape = (len(frames), *markers.joints.shape[1:3])
    joints = np.full((*shape, 3), np.nan)
    covariance = np.full((*shape, 3, 3), np.nan)
    views = np.zeros(shape, np.int64)
    source = None if tracks.source is None else np.zeros((*shape[:2], len(COCO17)), np.int64)
    if source is not None:
        source[rows] = tracks.source
    joints[rows] = markers.joints
    if markers.covariance is not None:
        covariance[rows] = markers.covariance
    there = np.isfinite(joints[..., 0])
    covariance[~there] = np.nan
    views[there] = 1 if markers.views is None else markers.views[there[rows]]
    for person, joint in np.ndindex(shape[1:]):
        known = np.flatnonzero(there[:, person, joint])
        if len(known) < 2:
            continue
        gaps = np.setdiff1d(np.arange(known[0], known[-1]), known)
        if len(gaps):
            path = PchipInterpolator(known, joints[known, person, joint])
            joints[gaps, person, joint] = path(gaps)
    stated = None if tracks.covariance is None else covariance
    certainty = tracks.identity_certainty
    if certainty is not None:
        before = np.searchsorted(rows, np.arange(len(frames)), side="right") - 1
        certainty = certainty[before]
    extra = None
    if tracks.extra is not None:
        extra = ExtraTracks(
            tracks.extra.points,
            joints[:, :, len(COCO17) :],
            None if stated is None else stated[:, :, len(COCO17) :],
            views[:, :, len(COCO17) :],
        )
    return JointTracks(
        frames,
        tracks.person_ids,
        joints[:, :, : len(COCO17)],
        covariance=None if stated is None else stated[:, :, : len(COCO17)],
        views=views[:, :, : len(COCO17)],
        source=source,
        identity_certainty=certainty,
        extra=extra,
    )


def write_joints(path: str | os.PathLike[str], tracks: JointTracks) -> None:
    """Write a joints file, whole or not at all; equal tracks give equal bytes.

    Members: `frames` (frames,) int64, `person_ids` (persons,) int64, `joints` (frames, persons,
    17, 3) float64 [m, world], and where known `covariance` (frames, persons, 17, 3, 3) float64
    [m^2], `views` and `source` (frames, persons, 17) uint8, and `identity_certainty` (frames,
    persons) float64.
    Points besides COCO-17 are in `points`, their names as text, `extra_joints`,
    `extra_covariance` and `extra_views`.
    """
    arrays: dict[str, NDArray[np.generic]] = {
        "frames": tracks.frames.astype(np.int64),
        "person_ids": tracks.person_ids.astype(np.int64),
        "joints": tracks.joints.astype(np.float64),
    }
    if tracks.covariance is not None:
        arrays["covariance"] = tracks.covariance.astype(np.float64)
    for name, array in (("views", tracks.views), ("source", tracks.source)):
        if array is not None:
            arrays[name] = array.astype(np.uint8)
    if tracks.identity_certainty is not None:
        arrays["identity_certainty"] = tracks.identity_certainty.astype(np.float64)
    if tracks.extra is not None:
        arrays["points"] = np.array(tracks.extra.points, dtype=np.str_)
        arrays["extra_joints"] = tracks.extra.joints.astype(np.float64)
        if tracks.extra.covariance is not None:
            arrays["extra_covariance"] = tracks.extra.covariance.astype(np.float64)
        if tracks.extra.views is not None:
            arrays["extra_views"] = tracks.extra.views.astype(np.uint8)
    write_archive(Path(path), arrays)


def read_joints(path: str | os.PathLike[str]) -> JointTracks:
    """Read the tracks of a joints file.

    Raises:
        InputError: the file is absent or truncated, or has missing or unknown members, wrong shapes
            or infinite values; the error names file and place.
    """
    arrays: dict[str, Any] = dict(read_archive(Path(path), MEMBERS))
    points = {name: arrays.pop(name, None) for name in EXTRA_MEMBERS}
    try:
        extra = None
        if points["points"] is not None or points["extra_joints"] is not None:
            if points["points"] is None or points["extra_joints"] is None:
                raise wrong("points", "points with extra_joints", "one without the other")
            extra = ExtraTracks(
                tuple(map(str, points["points"].tolist())),
                points["extra_joints"],
                points["extra_covariance"],
                points["extra_views"],
            )
        return JointTracks(**arrays, extra=extra)
    except InputError as error:
        todo = error.todo
        raise InputError(f"{path}: {error.where}", error.expected, error.found, todo) from error


POSE_MEMBERS: Final = {
    "betas": Member(("persons", "shapes"), "float"),
    "global_orient": Member(("persons", "frames", 3), "float"),
    "body_pose": Member(("persons", "frames", 69), "float"),
    "transl": Member(("persons", "frames", 3), "float"),
    "body_model": Member((1,), "text", required=False),
}
"""Arrays of a pose file; persons first, unlike everywhere else here."""
PLURALS: Final = {"global_orients": "global_orient", "body_poses": "body_pose"}
"""Names in the release's own note, which are also accepted."""


def write_poses(path: Path, poses: BodyParameters, body_model: str) -> None:
    """Write `poses/<clip>.npz`, whole or not at all; equal poses give equal bytes.

    Members in single precision, with an error of at most 4 um on a pitch of 105 m: `betas`
    (persons, shapes) of the first frame, `global_orient` (persons, frames, 3) [rad], `body_pose`
    (persons, frames, 69) [rad], `transl` (persons, frames, 3) [m, world]. NaN where a person is
    missing. The release has one body model; here `body_model` (1,) is its name and version, since
    betas of another are meaningless.
    """
    arrays: Mapping[str, NDArray[np.float64]] = {
        "betas": poses.betas[:, 0],
        "global_orient": poses.global_orient,
        "body_pose": poses.body_pose,
        "transl": poses.transl,
    }
    single = {name: array.astype(np.float32) for name, array in arrays.items()}
    write_archive(path, {**single, "body_model": np.array([body_model])})


def read_poses(path: Path) -> tuple[BodyParameters, str | None]:
    """Read the poses (persons, frames) of a file and the name of their body model, or None."""
    errors: list[InputError] = []
    for renamed in ({}, PLURALS):
        back = {name: plural for plural, name in renamed.items()}
        members = {back.get(name, name): member for name, member in POSE_MEMBERS.items()}
        try:
            arrays: dict[str, NDArray[Any]] = read_archive(path, members)
        except InputError as error:
            errors.append(error)
            continue
        for name, array in arrays.items():
            if array.dtype.kind == "f" and np.isinf(array).any():
                todo = "Correct what wrote the file."
                raise wrong(f"{path}: {name}", "finite numbers, NaN where missing", "inf", todo)
        named = {renamed.get(name, name): array for name, array in arrays.items()}
        poses = BodyParameters(
            betas=named["betas"][:, None],
            global_orient=named["global_orient"],
            body_pose=named["body_pose"],
            transl=named["transl"],
        )
        return poses, str(named["body_model"][0]) if "body_model" in named else None
    raise errors[0]
