"""Replay of identity corrections over the tracker's result."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from data_contracts.review import MergedTracks, NamedTrack, Sighting, SplitTrack
from data_contracts.tracking import Join, Track
from data_contracts.triangulation import CameraChange

if TYPE_CHECKING:
    import xarray as xr

TrackEdit: TypeAlias = MergedTracks | SplitTrack
IdentityEdit: TypeAlias = TrackEdit | NamedTrack
T = TypeVar("T", bound=np.generic)
TRACK_EDITS = (MergedTracks, SplitTrack)
"""Corrections that results of tracking depend on."""
IDENTITY_EDITS = (*TRACK_EDITS, NamedTrack)


@dataclass(frozen=True, eq=False)
class Identities:
    """Identities of one clip, from the tracker or with corrections.

    Attributes:
        frame: (frames,) match frames.
        cameras: ids in the order of the camera dimension.
        person: (persons,) ids.
        detection_index: (frames, cameras, persons), -1 = not seen.
        ray_distance: (frames, cameras, persons) [m]; NaN = not seen.
        joints: (frames, persons, 17, 3) [m], world; NaN where missing.
        on_plane: (frames, persons), whether the person is not triangulated there, and placed by
            the feet.
        names: roster id or name by person, of named people.
        joins: certain and possible continuations of one track as another.
        changes: cameras that changed so much within the clip that the tracker lost their people.
    """

    frame: NDArray[np.integer]
    cameras: tuple[str, ...]
    person: NDArray[np.int32]
    detection_index: NDArray[np.int16]
    ray_distance: NDArray[np.float32]
    joints: NDArray[np.float32]
    on_plane: NDArray[np.bool_]
    names: dict[int, str]
    joins: tuple[Join, ...]
    changes: tuple[CameraChange, ...] = ()

    @property
    def tracks(self) -> tuple[Track, ...]:
        """One summary per person, in the order of `person`."""
        found = []
        for k, person in enumerate(self.person.tolist()):
            views = np.count_nonzero(self.detection_index[:, :, k] >= 0, axis=1)
            present = np.flatnonzero(views)
            plane_frames = int(np.count_nonzero(self.on_plane[:, k]))
            is_plane = not (views[~self.on_plane[:, k]] > 0).any()
            found.append(
                Track(
                    person=person,
                    first_frame=int(present[0]),
                    last_frame=int(present[-1]),
                    frames_seen=len(present),
                    views=float(views[present].mean()),
                    name=self.names.get(person),
                    kind="triangulated" if not plane_frames else "plane" if is_plane else "mixed",
                    plane_frames=plane_frames,
                )
            )
        return tuple(found)


@dataclass(frozen=True, eq=False)
class IdentityReplay:
    """Identities with corrections applied; per edit, why it does not apply, or None."""

    identities: Identities
    objections: tuple[str | None, ...]


def stored_identities(result: xr.Dataset, *, with_joints: bool = True) -> Identities:
    """Return the identities of a published result of stage `tracking`, without names.

    Without joints, `joints` has none, and all ray distances are 0.
    """
    index = result["detection_index"].values
    no_joints = np.zeros((len(index), index.shape[2], 0, 3), dtype=np.float32)
    no_distance = np.zeros(index.shape, dtype=np.float32)
    return Identities(
        frame=result["frame"].values,
        cameras=tuple(str(name) for name in result["camera"].values),
        person=result["person"].values,
        detection_index=index,
        ray_distance=result["ray_distance"].values if with_joints else no_distance,
        joints=result["joints"].values if with_joints else no_joints,
        on_plane=find_plane_frames(result),
        names={},
        joins=tuple(Join.model_validate(join) for join in result.attrs["joins"]),
        changes=tuple(CameraChange.model_validate(each) for each in result.attrs["changes"]),
    )


def find_plane_frames(tracks: xr.Dataset) -> NDArray[np.bool_]:
    """Return in which frames of tracks the feet alone place a person (frames, persons)."""
    if "ground" not in tracks:
        return np.zeros((tracks.sizes["frame"], tracks.sizes["person"]), dtype=np.bool_)
    return np.asarray(np.isfinite(tracks["ground"].values).all(axis=-1))


def select_triangulated(tracks: xr.Dataset) -> xr.Dataset:
    """Return tracks, or some frames of them, without what the feet alone place."""
    if "ground" not in tracks:
        return tracks
    kinds = [Track.model_validate(track).kind for track in tracks.attrs["tracks"]]
    kept = [k for k, kind in enumerate(kinds) if kind != "plane"]
    on_plane = find_plane_frames(tracks)[:, kept]
    index = tracks["detection_index"]
    # Read whole: a list of people in a store would be read number by number.
    values = np.where(on_plane[:, None], np.int16(-1), index.values[:, :, kept])
    return tracks.isel(person=kept).assign(detection_index=(index.dims, values))


def add_plane_tracks(
    found: Identities,
    detection_index: NDArray[np.int16],
    is_placed: NDArray[np.bool_],
    continues: NDArray[np.integer],
) -> Identities:
    """Add people on the plane, and the frames in which the feet place triangulated people.

    Tracks by feet have detections (frames, cameras, tracks) as in `Identities`, and a place in some
    frames (frames, tracks). Each continues a triangulated person, index in `found.person`, -1 =
    none.
    """
    index, on_plane = found.detection_index.copy(), found.on_plane.copy()
    for n in np.flatnonzero(continues >= 0):
        person = continues[n]
        index[:, :, person] = np.maximum(index[:, :, person], detection_index[:, :, n])
        on_plane[:, person] |= is_placed[:, n]
    new = np.flatnonzero(continues < 0)
    first = int(found.person.max(initial=-1)) + 1

    def widen(array: NDArray[T], axis: int) -> NDArray[T]:
        shape = list(array.shape)
        shape[axis] = len(new)
        return np.concatenate([array, np.full(shape, np.nan, dtype=array.dtype)], axis=axis)

    return replace(
        found,
        person=np.append(found.person, first + np.arange(len(new))).astype(np.int32),
        detection_index=np.concatenate([index, detection_index[:, :, new]], axis=2),
        ray_distance=widen(found.ray_distance, 2),
        joints=widen(found.joints, 1),
        on_plane=np.concatenate([on_plane, is_placed[:, new]], axis=1),
    )


def replay_identities(found: Identities, edits: Iterable[IdentityEdit]) -> IdentityReplay:
    """Return the identities with edits applied in order, without new computation.

    Each edit uses the ids after the previous edits. An edit applies only if the sightings of its
    people still match; a merged person's detections go to the kept person.
    """
    objections = []
    for edit in edits:
        objection = find_objection(found, edit)
        objections.append(objection)
        if objection is None:
            found = _apply(found, edit)
    return IdentityReplay(found, tuple(objections))


def find_objection(found: Identities, edit: IdentityEdit) -> str | None:
    """Return why an edit does not apply to these identities; None if it does."""
    if isinstance(edit, MergedTracks):
        people: Sequence[tuple[int, Sighting | None]] = (
            (edit.kept, edit.kept_seen),
            (edit.merged, edit.merged_seen),
        )
    else:
        people = ((edit.person, edit.seen),)
    ids = found.person.tolist()
    for person, seen in people:
        if person not in ids:
            return f"clip {edit.clip} has no person {person}"
        if seen is not None and not _is_seen(found, person, seen):
            return (
                f"{_called(found, person)} is not the person that was seen in {seen.camera}, frame "
                f"{seen.frame}"
            )
    if isinstance(edit, MergedTracks):
        if edit.kept == edit.merged:
            return f"{_called(found, edit.kept)} is one person already"
        kept, merged = (found.detection_index[:, :, ids.index(n)] for n, _ in people)
        both = np.flatnonzero(((kept >= 0) & (merged >= 0)).any(axis=1))
        if len(both):
            frame = int(found.frame[both[0]])
            return (
                f"one camera sees {_called(found, edit.kept)} and {_called(found, edit.merged)} "
                f"side by side in {len(both)} frames, the first is frame {frame}"
            )
    if isinstance(edit, SplitTrack):
        seen_in = (found.detection_index[:, :, ids.index(edit.person)] >= 0).any(axis=1)
        later = found.frame >= edit.first_frame_of_new
        if not (seen_in & later).any() or not (seen_in & ~later).any():
            who, at = _called(found, edit.person), edit.first_frame_of_new
            return f"{who} is not seen both before and from frame {at}"
    return None


def _called(found: Identities, person: int) -> str:
    name = found.names.get(person)
    return f"person {person}" if name is None else f"person {person} ({name})"


def find_sighting(found: Identities, person: int, first: int = 0) -> Sighting | None:
    """Return a person's detection of smallest ray distance from match frame `first` on, or None."""
    k = found.person.tolist().index(person)
    seen = (found.detection_index[:, :, k] >= 0) & (found.frame >= first)[:, None]
    if not seen.any():
        return None
    distance = np.where(seen, np.nan_to_num(found.ray_distance[:, :, k], nan=1e9), np.inf)
    frame, camera = np.unravel_index(int(np.argmin(distance)), distance.shape)
    return Sighting(
        camera=found.cameras[int(camera)],
        frame=int(found.frame[frame]),
        detection=int(found.detection_index[frame, camera, k]),
    )


def _is_seen(found: Identities, person: int, seen: Sighting) -> bool:
    frame = np.flatnonzero(found.frame == seen.frame)
    if seen.camera not in found.cameras or not len(frame):
        return False
    k = found.person.tolist().index(person)
    camera = found.cameras.index(seen.camera)
    return bool(found.detection_index[frame[0], camera, k] == seen.detection)


def _apply(found: Identities, edit: IdentityEdit) -> Identities:
    if isinstance(edit, MergedTracks):
        return _merge(found, edit.kept, edit.merged)
    if isinstance(edit, SplitTrack):
        return _split(found, edit.person, edit.first_frame_of_new)
    names = {n: name for n, name in found.names.items() if n != edit.person}
    return replace(found, names=names if edit.name is None else {**names, edit.person: edit.name})


def _merge(found: Identities, kept: int, merged: int) -> Identities:
    ids = found.person.tolist()
    a, b = ids.index(kept), ids.index(merged)
    index, distance = found.detection_index.copy(), found.ray_distance.copy()
    joints = found.joints.copy()
    taken = index[:, :, b] >= 0
    index[:, :, a] = np.where(taken, index[:, :, b], index[:, :, a])
    distance[:, :, a] = np.where(taken, distance[:, :, b], distance[:, :, a])
    joints[:, a] = np.where(np.isfinite(joints[:, a]), joints[:, a], joints[:, b])
    # In a frame where either is tracked in 3D, the kept person is.
    tracked = (found.detection_index[:, :, [a, b]] >= 0).any(axis=1) & ~found.on_plane[:, [a, b]]
    on_plane = found.on_plane.copy()
    on_plane[:, a] = found.on_plane[:, [a, b]].any(axis=1) & ~tracked.any(axis=1)
    left = [k for k in range(len(ids)) if k != b]
    names = {n: name for n, name in found.names.items() if n != merged}
    if merged in found.names:
        names.setdefault(kept, found.names[merged])
    joins = []
    for join in found.joins:
        ends = [kept if n == merged else n for n in (join.before, join.after)]
        said = {join.before, join.after} == {kept, merged}
        margin = None if said else join.margin
        update = {"before": ends[0], "after": ends[1], "decided": join.decided or said}
        joins.append(join.model_copy(update={**update, "margin": margin}))
    return replace(
        found,
        person=found.person[left],
        detection_index=index[:, :, left],
        ray_distance=distance[:, :, left],
        joints=joints[:, left],
        on_plane=on_plane[:, left],
        names=names,
        joins=tuple(joins),
    )


def _split(found: Identities, person: int, first_frame_of_new: int) -> Identities:
    k = found.person.tolist().index(person)
    later = found.frame >= first_frame_of_new

    def halves(array: NDArray[T], axis: int, missing: float) -> NDArray[T]:
        moved = np.moveaxis(array, axis, 1)
        new = moved[:, k].copy()
        new[~later] = missing
        old = moved.copy()
        old[later, k] = missing
        return np.moveaxis(np.concatenate([old, new[:, None]], axis=1), 1, axis)

    number = int(found.person.max()) + 1
    # Ends of tracks from that frame on are the new person's.
    joins = []
    for join in found.joins:
        ends = ((join.before, join.last_frame), (join.after, join.first_frame))
        before, after = (number if n == person and later[frame] else n for n, frame in ends)
        joins.append(join.model_copy(update={"before": before, "after": after}))
    return replace(
        found,
        person=np.append(found.person, np.int32(number)).astype(np.int32),
        detection_index=halves(found.detection_index, 2, -1),
        ray_distance=halves(found.ray_distance, 2, np.nan),
        joints=halves(found.joints, 1, np.nan),
        on_plane=halves(found.on_plane, 1, False),
        joins=tuple(joins),
    )
