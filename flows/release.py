"""Results of a run in the forms that other tools read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_contracts.match import MatchSpec
from data_contracts.run import RunRecord
from worldpose.cameras import Camera
from worldpose.cameras.stored import camera_from_arrays
from worldpose.errors import UsageError, WorldposeError
from worldpose.release import JointTracks, coco_dataset, write_coco, write_joints
from worldpose.store import Run

if TYPE_CHECKING:
    import xarray as xr

JOINT_STAGES = ("triangulation", "bundle_adjustment")
"""Stages that give 3D joints, the best last."""


def clips_of(record: RunRecord) -> tuple[str, ...]:
    """The clips for which a run has joints.

    Raises:
        WorldposeError: there are none.
    """
    units = [unit.partition("/") for unit in record.results]
    clips = tuple(sorted({unit for stage, _, unit in units if stage in JOINT_STAGES}))
    if not clips:
        raise WorldposeError(
            f"run {record.run_id} of {record.match_id}: expected results of {JOINT_STAGES[0]}, "
            f"found {', '.join(record.results) or 'none'}. Run the match to the end first."
        )
    return clips


def joint_tracks(run: Run, clip: str, stage: str | None = None) -> JointTracks:
    """The joints of one clip, of the best stage that has them or of the stage asked for.

    Raises:
        UsageError: the run has no such result.
    """
    result = joint_result(run, clip, stage)
    return JointTracks(
        frames=result["frame"].values,
        person_ids=result["person"].values.astype(np.int64),
        joints=result["joints"].values,
        covariance=result["covariance"].values,
        views=result["views"].values.astype(np.int64),
    )


def joint_result(run: Run, clip: str, stage: str | None = None) -> xr.Dataset:
    """The result with the joints of one clip, of the best stage or of the stage asked for.

    Raises:
        UsageError: the run has no such result.
    """
    for name in (f"{name}/{clip}" for name in reversed(JOINT_STAGES) if stage in (None, name)):
        if name in run:
            return run[name]
    raise UsageError(
        f"--stage {stage}" if stage else f"clip {clip}",
        expected=f"a result with joints: {', '.join(JOINT_STAGES)}",
        found=", ".join(run) or "an empty run",
        todo="Run the match to the end first.",
    )


def export_joints(run: Run, spec: MatchSpec, out: Path) -> list[Path]:
    """Writes `joints.npz`, or `<clip>.joints.npz` for each clip where there are several."""
    clips = clips_of(run.record)
    written = []
    for clip in clips:
        path = out / ("joints.npz" if len(clips) == 1 else f"{clip}.joints.npz")
        write_joints(path, joint_tracks(run, clip))
        written.append(path)
    return written


def export_coco(run: Run, spec: MatchSpec, out: Path) -> list[Path]:
    """Writes `<camera>.json` for each static camera, in `<clip>/` where there are several."""
    clips = clips_of(run.record)
    written = []
    for clip in clips:
        tracks = joint_tracks(run, clip)
        inliers = joint_result(run, clip)["inliers"]
        for camera_id, camera in static_cameras(run, spec, clip).items():
            dataset = coco_dataset(
                camera_id,
                camera,
                tracks,
                inliers.sel(camera=camera_id).values,
                offset_frames=int(spec.camera(camera_id).offset_frames),
            )
            path = (out if len(clips) == 1 else out / clip) / f"{camera_id}.json"
            write_coco(path, dataset)
            written.append(path)
    return written


def static_cameras(
    run: Run, spec: MatchSpec, clip: str | None = None, stage: str | None = None
) -> dict[str, Camera]:
    """The static cameras that a run has, by id; all of them where it has joints.

    Args:
        run: the run.
        spec: the match.
        clip: as the joints of this clip were placed with them; None = as they were calibrated.
        stage: as the joints of this stage were, instead of the best one's.
    """
    units = {camera.id: f"static_calibration/{camera.id}" for camera in spec.static_cameras}
    cameras = {
        camera_id: camera_from_arrays(run[unit].data_vars)
        for camera_id, unit in units.items()
        if unit in run
    }
    adjusted = f"bundle_adjustment/{clip}"
    if adjusted in run and stage in (None, "bundle_adjustment"):
        result = run[adjusted]
        batch = camera_from_arrays(result.data_vars)
        cameras |= {str(name): batch[k] for k, name in enumerate(result["camera"].values)}
    return cameras


EXPORTS: dict[str, Callable[[Run, MatchSpec, Path], list[Path]]] = {
    "joints": export_joints,
    "coco": export_coco,
}
"""Formats by name."""
