"""Export formats for labels, biomechanics, animation and tables, with notes where files can."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from data_contracts.conventions import COCO17
from data_contracts.run import BODY_STAGES, JOINT_STAGES
from data_contracts.triangulation import CameraChange
from flows.results import best_results
from flows.results.run_cameras import (
    BROADCAST,
    broadcast_unit,
    broadcast_views,
    camera_in_frames,
    estimated_pitch,
    moving_cameras,
    view_changes,
)
from worldpose.body.body_file import is_open_body
from worldpose.body.keypoints import HALPE26, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.body.occlusions import hidden_joints
from worldpose.errors import InputError, UsageError
from worldpose.formats import motion_capture
from worldpose.formats.c3d_file import write_c3d
from worldpose.formats.gltf_file import AnimatedBody, write_gltf
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.tables import (
    joints_table,
    people_table,
    strides_table,
    write_csv,
    write_parquet,
)
from worldpose.formats.usd_file import write_usd
from worldpose.geometry.cameras import Camera
from worldpose.ingest.clock import remaining_offset
from worldpose.ingest.footage import image_clock, unit_frames
from worldpose.store.store import Run
from worldpose.triangulation.camera_changes import (
    changed_camera,
    describe_change,
    left_out_frames,
    move_on,
)

if TYPE_CHECKING:
    import pandas as pd


LOG = logging.getLogger("worldpose.export")


def describe_clip(origin: best_results.Origin, clip: str) -> dict[str, str]:
    """Return what the files of a clip say about themselves, by a short name."""
    stages = [stage for stage in reversed(JOINT_STAGES) if f"{stage}/{clip}" in origin.run]
    stage = origin.stage or (stages[0] if stages else best_results.PLANE)
    said = origin.run.record.usability
    notes = {
        "software": f"worldpose {version('worldpose')}",
        "match": origin.spec.match_id,
        "run": origin.run.record.run_id,
        "clip": clip,
        "frames_per_second": f"{origin.spec.fps:g}",
        "world": "origin at the centre spot, x along the touch line, y across, z up, right-handed"
        if origin.spec.pitch != "none"
        else "the world of the given calibration, right-handed",
        "joints": _joint_definition(origin, clip, stage),
        "keypoints": _keypoint_source(origin.run),
        "filled": "gaps interpolated on request; joints without a contributing camera are flagged"
        if origin.filled
        else "joints without a contributing camera come from the motion or the rest of the body",
        # A text of C3D has at most 20 KB.
        "verdict": "; ".join((said.verdict, *said.reservations[:20]))
        + (f"; and {rest} more: see the run" if (rest := len(said.reservations) - 20) > 0 else ""),
        "licence": origin.licence or "not stated: ask the owner of the recording",
    }
    if changes := view_changes(origin.run, clip, origin.stage):
        notes["camera_changes"] = "cameras are as before their changes. " + "; ".join(
            describe_change(change) for change in changes
        )
    unit = best_results.bodies_unit(origin.run, clip)
    if unit in origin.run:
        model = str(origin.run[unit].attrs["body_model"])
        terms = "CC0 1.0" if is_open_body(model) else "the terms of its publisher apply"
        notes["body_model"] = f"{model} ({terms})"
        if "joint_offsets" in origin.run[unit]:  # a monocular method's bodies have none
            notes["joint_offsets_mm"] = _describe_offsets(origin.run[unit]["joint_offsets"].values)
    return notes


def _describe_offsets(offsets: Floats) -> str:
    """Return the offsets (17, 3) [m] from a body's joints to the detector's, in millimetres."""
    rounded = np.round(1e3 * offsets) + 0.0  # no -0
    return "forward, left, up in the body, from model to detector: " + ", ".join(
        f"{joint} " + " ".join(f"{number:.0f}" for number in offset)
        for joint, offset in zip(COCO17, rounded, strict=True)
    )


def _keypoint_source(run: Run) -> str:
    """Return which detector the 2D poses are of, with its version."""
    detected = [name for name in run if name.startswith("detection/")]
    if not detected:
        return "2D poses given with the match"
    recipe = run.manifest(detected[0]).recipe
    pose, sources = str(recipe.settings["pose"]), cast(dict[str, Any], recipe.sources)
    digest = sources["weights"][pose]
    if digest is None:
        return f"the {pose} pose net of this version"
    return f"{pose.rpartition('/')[2]}, SHA-256 {digest[:16]}"


def _joint_definition(origin: best_results.Origin, clip: str, stage: str) -> str:
    if stage in BODY_STAGES:
        fits = origin.run[f"{stage}/{clip}"]
        moved = origin.definition == "detector" and "joint_offsets" in fits
        best = moved and origin.stage is None
        how = ", but wrists and ankles where the model has them" if best else ""
        if f"{best_results.PLANE}/{clip}" in origin.run:
            how += ", from one camera by feet on the pitch and a monocular method's poses"
        elif best:
            how += "; triangulated without a body"
        owner, model = "detector sees" if moved else "model has", fits.attrs["body_model"]
        return f"COCO-17 keypoints of the fitted body {model}, where the {owner} them{how}"
    if stage == best_results.PLANE:
        return "none: people are placed on the pitch by their feet"
    return "COCO-17 keypoints of the detector, triangulated"


def export_coco(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `<camera or broadcast view>.json`, in `<clip>/` if there are several clips.

    A camera whose views the run leaves out in the whole clip has no file.
    """
    for clip in origin.clips:
        tracks = origin.tracks(clip)
        for view in image_views(origin, clip, tracks.frames):
            shown = replace(tracks, joints=view.at_images(tracks.joints))
            if view.name in origin.static_cameras:
                placed = best_results.placed_joints(origin.run, clip, origin.stage)
                seen = placed["inliers"].sel(camera=view.name).values
            else:
                seen = ~hidden_joints(shown.joints, view.camera)
            if not view.is_used(clip):
                continue
            path = (out if len(origin.clips) == 1 else out / clip) / f"{view.name}.json"
            labels = motion_capture.coco_dataset(
                view.name, view.camera, shown, seen, number=view.number, move=view.move
            )
            motion_capture.write_json(path, labels)
            yield path


def export_alphapose(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `alphapose/<clip>/<camera or broadcast view>.json` as `export_coco`."""
    for clip in origin.clips:
        model, poses, persons, frames = best_results.fitted_bodies(origin.run, clip)
        at_frames = fold_keypoints(model, HALPE26)(poses).swapaxes(0, 1)
        for view in image_views(origin, clip, frames):
            if not view.is_used(clip):
                continue
            points = view.at_images(at_frames)
            hidden = hidden_joints(points, view.camera)
            path = out / "alphapose" / clip / f"{view.name}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            labels = motion_capture.alphapose_results(
                view.project(points), hidden, persons, view.camera, view.number
            )
            motion_capture.write_json(path, labels)
            yield path


def filmed_cameras(
    origin: best_results.Origin, clip: str, *, leave_out: bool = False
) -> dict[str, Camera]:
    """Return the moving cameras of a clip in the frames of its bodies, (frames,), by view.

    They are for formats whose rows are images. With `leave_out`, a warning names the cameras of
    another frame rate, which are left out; else they are an InputError, as is no camera.
    """
    run, found = origin.run, {}
    todo = "Calibrate the clip's broadcast camera and run the match again. A match with static "
    todo += "cameras alone has other formats: worldpose export --format joints."
    views = broadcast_views(run, clip)
    views = views or [best_results.require_result(run, f"{BROADCAST}{clip}", todo)]
    bodies = best_results.bodies_unit(run, clip)
    frames = run[bodies if bodies in run else broadcast_unit(run, views[0])]["frame"].values
    for view in views:
        if (rate := unit_frames(origin.spec, view).rate) == 1.0:
            found[view] = camera_in_frames(run, view, frames)
            continue
        error = InputError(
            f"view {view}",
            expected="the frame rate of the match, as the format has a row for each image",
            found=f"{rate * origin.spec.fps:g} images per second, and {origin.spec.fps:g} "
            "frames of the match",
            todo="Set fps of the match to the camera's, or convert its video.",
        )
        if not leave_out:
            raise error
        LOG.warning("this camera is left out: %s", error)
    return found


@dataclass(frozen=True, eq=False)
class ImageView:
    """Images of a camera in consecutive match frames of a clip.

    Attributes:
        name: the camera or the broadcast view.
        camera: a static camera, or that of each image (frames,).
        frame: (frames,) match frames.
        number: (frames,) the camera's own frames; -1 where the run leaves its views out.
        late: (frames,) how much later than the match frames the images are [match frame].
        changes: changes of the view within the clip.
    """

    name: str
    camera: Camera
    frame: Integers
    number: Integers
    late: Floats
    changes: Sequence[CameraChange] = ()

    def is_used(self, clip: str) -> bool:
        """Return whether the run uses an image of this view; warn if not."""
        if is_unused := bool(left_out_frames(self.changes, self.frame).all()):
            text = "clip %s: no labels of camera %s, whose views the run leaves out"
            LOG.warning(text, clip, self.name)
        return not is_unused

    def at_images(self, points: Floats, rows: Integers | None = None) -> Floats:
        """Return points (frames, ...) at the moments of the images, in some rows or in all.

        x(t) = x(f) + (t - f) v, with the step v per frame to the next frame if t > f, else from the
        one before; the other one, or none, where that is not known.
        """
        at = np.arange(len(points)) if rows is None else rows
        here, late = points if rows is None else points[rows], self.late[at]
        if not late.any():
            return here
        shape = (-1, *(1,) * (points.ndim - 1))

        def speed(side: Integers) -> Floats:
            near = np.clip(at + side, 0, len(points) - 1)
            step = side.reshape(shape) * (points[near] - here)
            return np.where((near == at).reshape(shape), np.nan, step)

        toward = np.where(late > 0, 1, -1)
        wanted, other = speed(toward), speed(-toward)
        wanted = np.where(np.isfinite(wanted), wanted, other)
        return np.asarray(here + late.reshape(shape) * np.nan_to_num(wanted))

    def move(self, pixels: Floats) -> Floats:
        """Return pixels (frames, ..., 2) of the unchanged camera where the images show them."""
        return move_on(pixels, self.frame, self.camera, self.changes)

    def camera_in(self, frame: int) -> Camera:
        """Return a static camera as it is in a match frame."""
        return changed_camera(self.camera, frame, self.changes)

    def project(self, points: Floats) -> Floats:
        """Return pixels (frames, ..., 2) of points (frames, ..., 3) [m] at the images' moments."""
        pixels = self.camera.project(points.reshape(len(points), -1, 3))
        return self.move(pixels.reshape(*points.shape[:-1], 2))

    def show(self, points: Floats, rows: Integers) -> Floats:
        """Return pixels (rows, ..., 2) of a static camera's images in some rows.

        The points (frames, ..., 3) [m] are those of all match frames.
        """
        part = replace(self, frame=self.frame[rows], number=self.number[rows], late=self.late[rows])
        return part.project(self.at_images(points, rows))


def image_views(
    origin: best_results.Origin, clip: str, frame: NDArray[np.integer], *, corrected: bool = False
) -> Iterator[ImageView]:
    """Yield the views of all cameras in consecutive match frames of a clip, static ones first.

    With `corrected`, only changes count that the run corrects, so that what it leaves out is shown.
    """
    frames = frame.astype(np.int64)
    changes = view_changes(origin.run, clip, origin.stage)
    changes = [each for each in changes if each.is_explained or not corrected]
    for name, camera in origin.static_cameras.items():
        own = [each for each in changes if each.camera == name]
        unit = unit_frames(origin.spec, name)
        number = np.where(left_out_frames(own, frames), -1, unit.numbers(frames))
        late = remaining_offset(frames, unit.offset, unit.rate)
        yield ImageView(name, camera, frames, number, late, own)
    for view in broadcast_views(origin.run, clip):
        clock = image_clock(origin.spec, view)
        row = frames - unit_frames(origin.spec, view).first
        camera = camera_in_frames(origin.run, view, frames)
        yield ImageView(view, camera, frames, clock.number[row], clock.late[row])


def export_markers(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `markers/<clip>/person_<id>.trc` for every person with a joint."""
    for clip in origin.clips:
        tracks = origin.tracks(clip)
        for person, person_id in _people_with_joints(tracks):
            path = out / "markers" / clip / f"person_{person_id:03d}.trc"
            motion_capture.write_markers(path, tracks, person, origin.spec.fps)
            yield path


def export_c3d(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `markers/<clip>/person_<id>.c3d` for every person with a joint."""
    for clip in origin.clips:
        tracks, people = origin.tracks(clip), best_results.describe_people(origin.run, clip)
        notes = describe_clip(origin, clip)
        for person, person_id in _people_with_joints(tracks):
            path = out / "markers" / clip / f"person_{person_id:03d}.c3d"
            about = {**people[person_id], "first_match_frame": f"{tracks.frames[0]}"}
            write_c3d(path, tracks, person, origin.spec.fps, notes | about)
            yield path


def _people_with_joints(tracks: JointTracks) -> Iterator[tuple[int, int]]:
    """Yield index and id of every person with a joint."""
    for person, person_id in enumerate(tracks.person_ids.tolist()):
        if np.isfinite(tracks.joints[:, person]).any():
            yield person, person_id


def export_motion(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `motion/<clip>/person_<id>_frame_<first>.bvh` for every uninterrupted interval."""
    for clip in origin.clips:
        model, poses, persons, frames = best_results.fitted_bodies(origin.run, clip)
        for name, person, part in _motions(poses, persons, frames):
            path = out / "motion" / clip / f"{name}.bvh"
            motion_capture.write_motion(path, model, poses[person, part], origin.spec.fps)
            yield path


def export_opensim(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `opensim/<clip>/person_<id>_frame_<first>.mot` for every uninterrupted interval."""
    for clip in origin.clips:
        model, poses, persons, frames = best_results.fitted_bodies(origin.run, clip)
        people = best_results.describe_people(origin.run, clip)
        notes = describe_clip(origin, clip) | {
            "world": "x as in the world of the match, y up, z = minus its y",
            "joints": motion_capture.OPENSIM_CONVENTION,
            "units": "degrees, metres, seconds; time is match frame / frames per second",
        }
        for name, person, part in _motions(poses, persons, frames):
            path = out / "opensim" / clip / f"{name}.mot"
            motion_capture.write_opensim_motion(
                path,
                motion_capture.opensim_coordinates(model, poses[person, part]),
                frames[part] / origin.spec.fps,
                notes | people[int(persons[person])],
            )
            yield path


def _motions(
    poses: BodyParameters, persons: NDArray[np.int32], frames: Integers
) -> Iterator[tuple[str, int, slice]]:
    """Yield name, person index and frames of every uninterrupted interval of a clip's bodies."""
    for person, person_id in enumerate(persons):
        for part in motion_capture.stretches(poses[person]):
            yield f"person_{person_id:03d}_frame_{frames[part.start]:06d}", person, part


def export_scenes(
    origin: best_results.Origin, out: Path, suffix: str, write: Callable[..., None]
) -> Iterator[Path]:
    """Write `scenes/<clip>.<suffix>`: bodies, cameras and the pitch."""
    # Imported here: it loads matplotlib's colours, which takes 0.5 s.
    from worldpose.reports.drawing import markings

    pitch = estimated_pitch(origin.run, origin.pitch, origin.spec)
    for clip in origin.clips:
        model, poses, persons, frames = best_results.fitted_bodies(origin.run, clip)
        free = is_open_body(model.name)
        if origin.surface and not free and origin.licence is None:
            raise UsageError(
                "--surface",
                expected=f"--licence FILE with the terms of body model {model.name}",
                found="none",
                todo="Give their text, which goes into the file, or export without --surface.",
            )
        cameras = origin.static_cameras | moving_cameras(
            origin.run, clip, frames, origin.static_cameras
        )
        known = best_results.describe_people(origin.run, clip)
        people = [
            AnimatedBody(
                f"person_{person_id:03d}",
                poses[person],
                {"person": person_id, **known[person_id], "body_model": model.name},
            )
            for person, person_id in enumerate(persons.tolist())
        ]
        notes = describe_clip(origin, clip)
        notes["joints"] = f"the 24 joints of body model {model.name}, named as SMPL's"
        notes |= {"units": "metres, seconds", "first_match_frame": f"{frames[0]}"}
        path = out / "scenes" / f"{clip}.{suffix}"
        write(
            path,
            model,
            people,
            origin.spec.fps,
            cameras=cameras,
            markings=[] if pitch is None else markings(pitch),
            notes=notes,
            surface=free or origin.surface,
        )
        yield path


def export_tables(
    origin: best_results.Origin,
    out: Path,
    suffix: str,
    write: Callable[[Path, pd.DataFrame, Mapping[str, str]], list[Path]],
) -> Iterator[Path]:
    """Write `tables/<clip>.<table>.<suffix>` for joints, people and strides."""
    fps = origin.spec.fps
    for clip in origin.clips:
        notes = {**describe_clip(origin, clip), "units": "in the name of each column"}
        notes["strides"] = "of people faster than 0.5 m/s, between two contacts of a foot"
        notes["height_m"] = "of people placed by their feet alone"
        tracks, people = origin.tracks(clip), best_results.describe_people(origin.run, clip)
        kinds = {person: about["kind"] for person, about in people.items()}
        names = {person: about.get("name", "") for person, about in people.items()}
        tables = {
            "joints": joints_table(tracks, fps, kinds),
            "people": people_table(best_results.clip_positions(origin.run, clip), fps),
            "strides": strides_table(tracks, fps),
        }
        for name, table in tables.items():
            if name != "people":  # whose positions have it
                named = table["person"].map(names).astype(object)
                table.insert(table.columns.get_loc("person") + 1, "name", named)
            yield from write(out / "tables" / f"{clip}.{name}.{suffix}", table, notes)


TOOL_EXPORTS: dict[str, Callable[[best_results.Origin, Path], Iterator[Path]]] = {
    "trc": export_markers,
    "c3d": export_c3d,
    "bvh": export_motion,
    "mot": export_opensim,
    "gltf": partial(export_scenes, suffix="glb", write=write_gltf),
    "usd": partial(export_scenes, suffix="usdc", write=write_usd),
    "csv": partial(export_tables, suffix="csv", write=write_csv),
    "parquet": partial(export_tables, suffix="parquet", write=write_parquet),
}
"""Part of `EXPORTS`."""
