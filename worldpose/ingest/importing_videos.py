"""Import of another tool's calibration and the cameras' videos into a match folder."""

from __future__ import annotations

import shutil
from pathlib import Path

from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.ingest.calibration_files import read_calibration
from worldpose.ingest.importing import files_by_camera, name_of
from worldpose.ingest.validation import validate_record
from worldpose.ingest.writing import write_match
from worldpose.video import index_frames

VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi")


def import_videos(
    calibration: Path,
    videos: Path,
    out: Path,
    fps: float | None = None,
    match_id: str | None = None,
) -> MatchSpec:
    """Write a match folder with the cameras of a calibration and copies of their videos.

    The only clip, `clip`, is as long as the shortest video. Videos begin together: `offset_frames`
    in match.yaml can shift them afterwards.

    Args:
        calibration: a file that `read_calibration` reads.
        videos: folder with `<camera>.mp4`, .mov, .mkv or .avi for each camera of the calibration.
        out: the match folder, absent or empty.
        fps: frame rate of all videos [1/s]; None = from the videos.
        match_id: id of the match; None = the name of `out`.

    Returns:
        Content of match.yaml.

    Raises:
        InputError: a file is invalid, names or rates do not match, or `out` is not empty; nothing
            is written then.
    """
    cameras = read_calibration(calibration)
    files = files_by_camera(videos, list(cameras), calibration, VIDEO_SUFFIXES)
    indices = {name: index_frames(file) for name, file in files.items()}
    rate = round(next(iter(indices.values())).fps, 3) if fps is None else fps
    counts = {name: len(index.on_clock(rate, str(files[name]))) for name, index in indices.items()}
    for name, index in indices.items():
        if index.size != cameras[name].image_size:
            raise InputError(
                str(files[name]),
                expected="{} x {} px, the size in the calibration".format(
                    *cameras[name].image_size
                ),
                found=f"{index.size[0]} x {index.size[1]}",
                todo="Give the video that was calibrated, in its size.",
            )
    content = {
        "match_id": match_id if match_id is not None else name_of(out),
        "fps": rate,
        "cameras": [
            {
                "id": name,
                "width": camera.image_size[0],
                "height": camera.image_size[1],
                "video": f"videos/{files[name].name}",
            }
            for name, camera in cameras.items()
        ],
        "clips": [{"id": "clip", "frame_count": min(counts.values())}],
        "pitch": "none",
    }
    spec = validate_record(MatchSpec, content, str(out / "match.yaml"))

    def copy(folder: Path) -> None:
        (folder / "videos").mkdir()
        for file in files.values():
            shutil.copyfile(file, folder / "videos" / file.name)

    write_match(out, spec, calibrations=cameras, observations={}, further=copy)
    return spec
