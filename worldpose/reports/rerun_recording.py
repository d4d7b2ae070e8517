"""Recording of a clip for the rerun viewer: people, markings and cameras over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data_contracts.arrays import Floats, find_runs
from data_contracts.conventions import COCO17_BONES
from data_contracts.pitch import PitchSpec
from worldpose.errors import UsageError
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.reports.drawing import markings, person_color, rgb


def write_recording(
    path: Path,
    tracks: JointTracks,
    fps: float,
    *,
    cameras: Mapping[str, Camera] | None = None,
    pitch: PitchSpec | None = None,
) -> None:
    """Write a recording (.rrd) atomically, with timelines `frame` and `time`.

    In the image of each static camera, the markings are where its lens shows them. Cameras are
    single, or one per frame of the tracks, NaN where missing. UsageError if rerun-sdk is not
    installed.
    """
    white = (235, 235, 235)
    try:
        import rerun as rr
    except ImportError:
        expected = "worldpose with the extra rerun"
        todo = "Install it: pip install 'worldpose[rerun]'."
        raise UsageError("format rerun", expected, "none installed", todo) from None
    application = "worldpose"
    with whole_file(path) as draft:
        stream = rr.RecordingStream(application, recording_id=path.stem)
        stream.save(draft)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        lines = [] if pitch is None else markings(pitch)
        if lines:
            strips = [line.tolist() for line in lines]
            painted = rr.LineStrips3D(strips, colors=[white], radii=[0.06])
            stream.log("world/pitch", painted, static=True)
        cameras = cameras or {}
        moving = {name: camera for name, camera in cameras.items() if camera.batch_shape}
        for name in [name for name in cameras if name not in moving]:
            _log_camera(rr, stream, f"world/cameras/{name}", cameras[name], static=True)
            seen = map(cameras[name].project, lines)
            parts = [part for line in seen for part in split_at_gaps(line)]
            shown = rr.LineStrips2D([part.tolist() for part in parts], colors=[white])
            stream.log(f"world/cameras/{name}/markings", shown, static=True)
        for row, frame in enumerate(tracks.frames):
            stream.set_time("frame", sequence=int(frame))
            stream.set_time("time", duration=float(frame) / fps)
            for name, camera in moving.items():
                if not np.isnan(camera.numbers[row]).any():
                    _log_camera(rr, stream, f"world/cameras/{name}", camera[row], static=False)
            stream.log("world/people", _skeletons(rr, tracks, row))
        stream.flush()
        stream.disconnect()


def split_at_gaps(line: Floats) -> list[Floats]:
    """Return the parts of a line (n, 2) of two points or more, none of which is missing."""
    runs = find_runs(np.asarray(np.isfinite(line).all(-1)))
    return [line[run] for run in runs if run.stop - run.start > 1]


def _skeletons(rr: Any, tracks: JointTracks, row: int) -> Any:  # noqa: ANN401
    """Return the bones of all people in one frame."""
    bone = 0.025  # radius of a bone [m]
    ends = tracks.joints[row][:, np.array(COCO17_BONES)]
    people, bones = np.nonzero(np.isfinite(ends).all((-1, -2)))
    shades = [rgb(person_color(int(number))) for number in tracks.person_ids]
    return rr.LineStrips3D(
        ends[people, bones],
        colors=[shades[person] for person in people.tolist()],
        radii=[bone] * len(people),
    )


def _log_camera(rr: Any, stream: Any, place: str, camera: Camera, *, static: bool) -> None:  # noqa: ANN401
    """Log one camera's pose and image plane; rerun's own cameras have no distortion."""
    pose = camera.cam_from_world.inverse()
    transform = rr.Transform3D(translation=pose.translation, mat3x3=pose.rotation)
    pinhole = rr.Pinhole(
        focal_length=np.array(camera.focal),
        principal_point=np.array(camera.principal_point),
        resolution=np.array(camera.image_size),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=8.0,
    )
    stream.log(place, transform, static=static)
    stream.log(place, pinhole, static=static)
