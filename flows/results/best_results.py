"""Results of a run for release: clips, the best joints, the best static cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.conventions import COCO17
from data_contracts.match import MatchSpec, Registration
from data_contracts.pitch import PitchSpec
from data_contracts.run import BODY_STAGES, JOINT_STAGES, RunRecord, RunState
from data_contracts.tracking import Join, Track
from flows.layers import pitch_of, pitch_of_run
from flows.overview import read_summary
from flows.results.run_cameras import (
    TRIANGULATED,
    broadcast_unit,
    broadcast_views,
    clip_of,
    static_cameras,
)
from flows.review.identities import names_of
from flows.stage import Match
from worldpose.body.body_file import find_body, is_open_body
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body_fitting.evidence import perceived_joints
from worldpose.body_fitting.extra_points import perceived_points
from worldpose.errors import InputError, UsageError
from worldpose.formats.joints_file import ExtraTracks, JointTracks, fill_gaps
from worldpose.formats.tables import Positions
from worldpose.geometry.cameras import Camera
from worldpose.store.runs import LATEST
from worldpose.store.store import Run, Store, open_run
from worldpose.tracking.joins import identity_certainty

if TYPE_CHECKING:
    import xarray as xr

    from worldpose.reports.bodies import BodyTracks

JointDefinition = Literal["body", "detector"]
"""Where a joint of a fitted body is: where the body model has it, or where the detector sees it."""
LIMB_ENDS = [9, 10, 15, 16]
"""Wrists and ankles in COCO-17, whose offset from body to detector nothing separates from the
length of the limb."""
PLANE = "broadcast_tracking"
"""Stage that places people on the pitch in clips without static cameras."""
MID_HIP = [11, 12]  # of COCO-17


def find_clips(record: RunRecord) -> tuple[str, ...]:
    """Return the clips for which a run has joints, or people on the pitch; empty without any."""
    units = [unit.partition("/") for unit in record.results]
    return tuple(sorted({unit for stage, _, unit in units if stage in (*JOINT_STAGES, PLANE)}))


def all_clips(run: Run) -> tuple[str, ...]:
    """Return the clips that have people or a calibrated moving camera."""
    moving = (clip_of(run, view) for view in broadcast_views(run))
    return tuple(sorted({*find_clips(run.record), *moving}))


def clips_of(record: RunRecord) -> tuple[str, ...]:
    """Return the clips for which a run has joints, or people on the pitch."""
    clips = find_clips(record)
    if not clips:
        stages = dict.fromkeys(name.partition("/")[0] for name in record.results)
        todo = f"Run the match to the end first: worldpose run {record.match_id}."
        if record.state == "waiting":
            units = ", ".join(unit.unit for unit in record.waiting)
            todo = f"First decide the pending review of {units}: worldpose review serve. {todo}"
        raise InputError(
            f"run {record.run_id} of {record.match_id}, which {RUN_ENDS[record.state]}",
            expected="people, in 3D or on the pitch",
            found=f"results of {', '.join(stages)}" if stages else "no results",
            todo=todo,
        )
    return clips


RUN_ENDS: Final[Mapping[RunState, str]] = {
    "complete": "is complete",
    "partial": "is partial",
    "waiting": "waits for review",
    "failed": "failed",
}
"""State of a finished run, as a predicate."""


def open_results(store: Store, match_id: str, run_id: str = LATEST) -> Run:
    """Open a run; for `latest`, the latest run with people, in 3D or on the pitch.

    A run that waits for review or failed comes after all others, which can have more results. If no
    run has people, `latest` is the latest run. InputError if there is no such run.
    """
    fallback = None
    for number in reversed(store.runs(match_id)) if run_id == LATEST else ():
        record = store.run(match_id, number)
        if not find_clips(record):
            continue
        if record.state in ("complete", "partial"):
            fallback = number
            break
        fallback = fallback or number
    return open_run(store.url, match_id, fallback or run_id)


def describe_age(store: Store, record: RunRecord) -> str:
    """Return a sentence about a later run, or about why the latest is out of date; or nothing."""
    if later := describe_later(store, record):
        return later
    now = read_summary(store, record.match_id)
    if now.is_silent:
        return now.problem
    if now.kind == "outdated":
        return f"These results are {now.words}. {now.todo}"
    # Open questions or a run at work say nothing about the results that are there.
    stale = now.units.get("stale", ())
    return f"Of these results, a run would compute {', '.join(stale)} anew." if stale else ""


def describe_later(store: Store, record: RunRecord) -> str:
    """Return a sentence about a later run; or nothing."""
    latest = store.run(record.match_id)
    if latest.run_id == record.run_id:
        return ""
    lacks = "" if find_clips(latest) else " and has no people"
    return (
        f"These are results of run {record.run_id}. The later run {latest.run_id} "
        f"{RUN_ENDS[latest.state]}{lacks}."
    )


def clip_title(clip: str) -> str:
    """Return the heading of a clip or a broadcast view."""
    return "The clip" if clip == "clip" else f"Clip {clip}"


def joint_tracks(
    run: Run, clip: str, stage: str | None = None, definition: JointDefinition = "body"
) -> JointTracks:
    """Return the joints of one clip, from the best available or the given stage.

    People that a broadcast camera alone films have the joints of their bodies, or NaN; there are
    none if the run ends with that camera. Triangulated joints have the detector's definition
    always. The best joints in that definition are those of the bodies, at `LIMB_ENDS` where the
    model has them, and triangulated ones without a body; `source` tells which. If the first
    triangulation is the best available, the frames that it skipped have the tracker's joints,
    without covariance.
    """
    stages = [name for name in reversed(JOINT_STAGES) if f"{name}/{clip}" in run]
    on_plane = f"{PLANE}/{clip}" in run
    if stage is None and not stages and not on_plane and (moving := broadcast_views(run, clip)):
        frames = run[broadcast_unit(run, moving[0])]["frame"].values
        return JointTracks(frames, np.zeros(0, np.int64), np.zeros((len(frames), 0, 17, 3)))
    if stage is None and on_plane and not (stages and run[f"{stages[0]}/{clip}"].sizes["person"]):
        tracked = run[f"{PLANE}/{clip}"]
        index = tracked["detection_index"].values
        return JointTracks(
            frames=tracked["frame"].values,
            person_ids=tracked["person"].values.astype(np.int64),
            joints=np.full((*index.shape, 17, 3), np.nan),
        )
    best = stage is None
    if stage in stages:
        stages = stages[stages.index(stage) :]
    elif stage is not None or not stages:
        raise UsageError(
            f"--stage {stage}" if stage else f"clip {clip}",
            expected=f"a result with joints: {', '.join(JOINT_STAGES)}",
            found=", ".join(run) or "an empty run",
            todo="Run the match to the end first.",
        )
    result = _stage_joints(run, clip, stages[0])
    fitted = stages[0] in BODY_STAGES
    seen = placed_joints(run, clip) if fitted and not on_plane else result
    joints, covariance = result["joints"].values, result["covariance"].values
    if "joint_offsets" not in result:  # a monocular method's bodies have none
        definition = "body"
    views = seen["views"].values.astype(np.int64)
    if best and stages[0] == "triangulation":
        joints, views = _with_tracked_joints(run, clip, joints, views)
    if stages[0] in BODY_STAGES and definition == "detector":
        joints = perceived_joints(joints, result["joint_offsets"].values)
    kind = 1 if stages[0] not in BODY_STAGES else 2 if definition == "detector" else 3
    source = np.where(np.isfinite(joints[..., 0]), kind, 0)
    no_body = None
    if best and fitted and definition == "detector":
        no_body = (source == 0).all(axis=-1)
        ends = np.isin(np.arange(len(COCO17)), LIMB_ENDS) & (source > 0)
        alone = (source == 0) & np.isfinite(seen["joints"].values[..., 0])
        for part, given, kind in ((ends, result, 3), (alone, seen, 1)):
            joints = np.where(part[..., None], given["joints"].values, joints)
            covariance = np.where(part[..., None, None], given["covariance"].values, covariance)
            source[part] = kind
    return JointTracks(
        frames=result["frame"].values,
        person_ids=result["person"].values.astype(np.int64),
        joints=joints,
        covariance=covariance,
        views=views,
        source=source,
        identity_certainty=_identity_certainty(
            run, clip, result["frame"].values, result["person"].values
        ),
        extra=_extra_tracks(run, f"{stages[0]}/{clip}", result, seen, definition, no_body),
    )


def _identity_certainty(
    run: Run, clip: str, frames: Integers, people: NDArray[np.integer]
) -> Floats | None:
    """Return the probability (frames, people) of identities; NaN where feet place the people.

    None without static cameras.
    """
    tracking, _ = tracked_people(run, clip)
    if "joins" not in tracking.attrs:
        return None
    joins = [Join.model_validate(join) for join in tracking.attrs["joins"]]
    certainty = identity_certainty(joins, people, tracking.sizes["frame"])
    if "ground" in tracking:
        ground = tracking["ground"].sel(person=people).values[..., 0]
        certainty[np.isfinite(ground)] = np.nan
    return certainty[np.searchsorted(tracking["frame"].values, frames)]


def _extra_tracks(
    run: Run,
    unit: str,
    result: xr.Dataset,
    seen: xr.Dataset,
    definition: JointDefinition,
    alone: Flags | None,
) -> ExtraTracks | None:
    """Return the points besides COCO-17 of bodies or triangulated joints; None without any.

    `result` is that of the unit, `seen` is the triangulation of the same people, whose points count
    where people (frames, persons) have no body: `alone`; None = nowhere.
    """
    if "extra_joints" not in result:
        return None
    points = tuple(result["point"].values.tolist())
    joints = result["extra_joints"].values
    if "extra_offsets" in result and definition == "detector":
        bodies = BodyParameters(
            np.broadcast_to(result["betas"].values, (*joints.shape[:2], result["betas"].shape[-1])),
            *(result[name].values for name in ("global_orient", "body_pose", "transl")),
        )
        model = fitted_model(run, unit)
        offsets = result["extra_offsets"].values
        joints = joints + perceived_points(model, points, bodies, offsets)
    covariance, there = result["extra_covariance"].values, seen.sel(point=list(points))
    if alone is not None:
        part = np.isnan(joints[..., 0]) & alone[..., None]
        joints = np.where(part[..., None], there["extra_joints"].values, joints)
        given = there["extra_covariance"].values
        covariance = np.where(part[..., None, None], given, covariance)
    views = there["extra_views"].values.astype(np.int64)
    return ExtraTracks(points, joints, covariance, views)


def tracked_people(run: Run, clip: str) -> tuple[xr.Dataset, dict[int, Track]]:
    """Return the tracking of one clip, and its people by id, with their newest names."""
    plane = f"{PLANE}/{clip}"
    tracking = run[plane if plane in run else f"tracking/{clip}"]
    names = names_of(run, clip)
    found = {}
    for track in map(Track.model_validate, tracking.attrs["tracks"]):
        found[track.person] = track.model_copy(update={"name": names.get(track.person)})
    return tracking, found


def person_kinds(run: Run, clip: str) -> dict[int, str]:
    """Return the kind of every person of a clip, by id: triangulated, mixed or plane."""
    return {person: track.kind for person, track in tracked_people(run, clip)[1].items()}


def describe_people(run: Run, clip: str) -> dict[int, dict[str, str]]:
    """Return kind, and name if known, of every person of a clip, by id."""
    people = tracked_people(run, clip)[1].items()
    return {
        person: {"kind": track.kind, **({"name": track.name} if track.name else {})}
        for person, track in people
    }


def clip_positions(run: Run, clip: str) -> Positions:
    """Return the people of one clip on the pitch: the mid-hip of their joints, or their feet.

    The joints are those of an export by default.
    Bodies of people that a broadcast camera alone films stand where their feet do: kind plane.
    """
    tracks = joint_tracks(run, clip, definition="detector")
    tracking, known = tracked_people(run, clip)
    person = tracking["person"].values.astype(np.int64)
    xy = np.full((len(tracks.frames), len(person), 2), np.nan)
    covariance = np.full((*xy.shape, 2), np.nan)
    column = np.searchsorted(person, tracks.person_ids)
    xy[:, column] = tracks.joints[:, :, MID_HIP, :2].mean(axis=2)
    if tracks.covariance is not None:  # the errors of both hips are nearly the same
        covariance[:, column] = tracks.covariance[:, :, MID_HIP, :2, :2].mean(axis=2)
    height, on_plane = np.full(len(person), np.nan), np.zeros(xy.shape[:2], dtype=np.bool_)
    if "ground" in tracking:
        feet = tracking.sel(frame=tracks.frames)
        on_plane = np.isnan(xy[..., 0]) & np.isfinite(feet["ground"].values[..., 0])
        xy[on_plane] = feet["ground"].values[on_plane]
        covariance[on_plane] = feet["ground_covariance"].values[on_plane]
        height = feet["ground_height"].values.astype(np.float64)
    if f"{PLANE}/{clip}" in run:
        on_plane = np.isfinite(xy[..., 0])
    names = [known[one].name or "" for one in person.tolist()]
    certainty = _identity_certainty(run, clip, tracks.frames, person)
    if certainty is None:
        certainty = np.full(on_plane.shape, np.nan)
    return Positions(tracks.frames, person, names, on_plane, xy, covariance, height, certainty)


def bodies_unit(run: Run, clip: str) -> str:
    """Return the name of a clip's best bodies, as `stage/unit`, whether or not they exist."""
    first, again = (f"{stage}/{clip}" for stage in BODY_STAGES)
    return again if again in run else first


def fitted_model(run: Run, unit: str) -> BodyModel:
    """Return the body model of a result `stage/unit`, from the folder that the run was given.

    UsageError if none of that name is installed there, InputError if it is not the one fitted.
    """
    name, folder = run[unit].attrs["body_model"], run.record.body_folder
    fitted = {} if is_open_body(name) else run.manifest(unit).recipe.sources
    place = None if folder is None else Path(folder)
    sha256 = fitted.get("body_model_sha256")
    return find_body(name, place, None if sha256 is None else str(sha256))


def body_tracks(run: Run, clip: str) -> BodyTracks | None:
    """Return the best fitted bodies of a clip; None if the run has none."""
    from worldpose.reports.bodies import BodyTracks  # late: it imports matplotlib

    unit = bodies_unit(run, clip)
    if unit not in run:
        return None
    fits = run[unit]
    return BodyTracks(
        frames=fits["frame"].values,
        person_ids=fits["person"].values.astype(np.int64),
        poses=BodyParameters(
            *(fits[name].values for name in ("betas", "global_orient", "body_pose", "transl"))
        ),
        model=fitted_model(run, unit),
    )


@dataclass(frozen=True)
class Origin:
    """Run whose results an export writes, with the options of the export."""

    run: Run
    registration: Registration
    stage: str | None = None
    """Stage whose joints are exported; None = the best available."""
    filled: bool = False
    """Interpolate joints that are missing for a while."""
    licence: str | None = None
    """Text of the data's licence; None = not stated."""
    surface: bool = False
    """Write also the surface of a body model that has terms of its own."""
    definition: JointDefinition = "detector"
    """Definition of the joints of bodies."""
    footage: tuple[Store, Match] | None = None
    """Videos to embed in viewer files, and the store whose latest run maps frames; None = none."""

    @property
    def spec(self) -> MatchSpec:
        """Return the match."""
        return self.registration.spec

    @property
    def clips(self) -> tuple[str, ...]:
        """Return the clips that have joints."""
        return clips_of(self.run.record)

    @property
    def static_cameras(self) -> dict[str, Camera]:
        """Return the static cameras of the exported joints, by id."""
        return static_cameras(self.run, self.spec, self.stage)

    @property
    def pitch(self) -> PitchSpec | None:
        """Return the pitch of the run; None without one."""
        folder = Path(self.registration.folder)
        return pitch_of_run(self.run, lambda: pitch_of(self.run.store, folder, self.spec))

    def tracks(self, clip: str) -> JointTracks:
        """Return the joints of one clip."""
        tracks = joint_tracks(self.run, clip, self.stage, self.definition)
        return fill_gaps(tracks) if self.filled else tracks


def fitted_bodies(
    run: Run, clip: str
) -> tuple[BodyModel, BodyParameters, NDArray[np.int32], Integers]:
    """Return body model, poses (persons, frames), person ids, and match frames of a clip's fits.

    InputError if the run has no fitted bodies.
    """
    unit = require_result(run, bodies_unit(run, clip), "Run the match to the end first.")
    fits = run[unit]
    poses = BodyParameters(
        fits["betas"].values[:, None],
        *(fits[name].values.swapaxes(0, 1) for name in ("global_orient", "body_pose", "transl")),
    )
    return fitted_model(run, unit), poses, fits["person"].values, fits["frame"].values


def require_result(run: Run, unit: str, todo: str) -> str:
    """Return the name of a result that the run has."""
    if unit not in run:
        raise InputError(
            f"run {run.record.run_id} of {run.record.match_id}",
            expected=f"results of {unit}",
            found=", ".join(sorted({name.partition("/")[0] for name in run})) or "none",
            todo=todo,
        )
    return unit


def _stage_joints(run: Run, clip: str, stage: str) -> xr.Dataset:
    """Return a stage's joints in every frame; missing where the first triangulation skipped one."""
    result = run[f"{stage}/{clip}"]
    if stage != "triangulation":
        return result
    frame = run[f"tracking/{clip}"]["frame"]
    if result.sizes["frame"] == frame.sizes["frame"]:
        return result
    unknown = {
        str(name): np.nan if array.dtype.kind == "f" else np.zeros((), array.dtype)
        for name, array in result.data_vars.items()
    }
    return result.reindex(frame=frame, fill_value=unknown)


def _with_tracked_joints(
    run: Run, clip: str, joints: Floats, views: Integers
) -> tuple[Floats, Integers]:
    """Return joints (frames, persons, 17, 3) [m] and views (frames, persons, 17) of a clip.

    The frames that triangulation skipped have those of the tracker.
    """
    computed = run[f"triangulation/{clip}"]
    tracking = run[f"tracking/{clip}"].sel(person=computed["person"])
    skipped = ~tracking["frame"].isin(computed["frame"]).values
    matched = (tracking["detection_index"].values >= 0).sum(axis=1)
    joints, views = joints.copy(), views.copy()
    joints[skipped] = tracking["joints"].values[skipped]
    seen = np.isfinite(joints[skipped, ..., 0])
    views[skipped] = np.where(seen, matched[skipped, :, None], 0)
    return joints, views


def placed_joints(run: Run, clip: str, stage: str | None = None) -> xr.Dataset:
    """Return the joints of one clip that `stage` or the best one triangulated, with their views."""
    for each in TRIANGULATED[stage == "triangulation" :]:
        if f"{each}/{clip}" in run:
            return _stage_joints(run, clip, each)
    raise UsageError(
        f"clip {clip}",
        expected="triangulated joints",
        found=", ".join(run) or "an empty run",
        todo="Run the match to the end first.",
    )
