"""What the page about a run says of the broadcast camera."""

from __future__ import annotations

import numpy as np

from data_contracts.broadcast_calibration import FRAME_STATUS
from flows.release import broadcast_cameras, joint_tracks
from flows.stage import Match
from worldpose.ingest import unit_frames
from worldpose.release import Picture
from worldpose.release.broadcast_pictures import course_picture
from worldpose.release.report import Table
from worldpose.release.stadium_pictures import camera_picture
from worldpose.store import Run
from worldpose.video import VideoReader


def broadcast_pictures(run: Run, match: Match) -> list[Picture]:
    """The course of each clip's broadcast camera, and its pictures where it is known least."""
    pictures = []
    for clip, camera in broadcast_cameras(run).items():
        result = run[f"broadcast_calibration/{clip}"]
        frame, expected = result["frame"].values, result["reprojection_error"].values
        pictures.append(
            Picture(
                f"Clip {clip}: the broadcast camera over its frames, with bands of two standard "
                "deviations.",
                course_picture(frame, camera, result["covariance"].values),
            )
        )
        if not np.isfinite(expected).any():
            continue
        worst = int(np.nanargmax(expected))
        number = int(frame[worst])
        tracks = joint_tracks(run, clip)
        video_frame = number + unit_frames(match.folder.spec, clip).offset
        with VideoReader(match.folder.videos[clip]) as video:
            still = video.frame(video_frame)
        pictures.append(
            Picture(
                f"Clip {clip}, frame {number}, where the broadcast camera is known least "
                f"({expected[worst]:.2g} px): markings and people as it projects them.",
                camera_picture(
                    camera[worst],
                    f"broadcast camera, frame {number}",
                    tracks,
                    int(np.searchsorted(tracks.frames, number)),
                    still=still,
                    pitch=match.folder.pitch,
                ),
            )
        )
    return pictures


def broadcast_tables(run: Run) -> list[Table]:
    """What the frames of each clip rest on, and what a person should look at."""
    tables = []
    for clip in broadcast_cameras(run):
        result = run[f"broadcast_calibration/{clip}"]
        status = np.bincount(result["status"].values, minlength=len(FRAME_STATUS))
        rows = [
            *(
                (f"frames that rest on: {name.replace('_', ' ')}", str(count))
                for name, count in zip(FRAME_STATUS, status, strict=True)
                if count
            ),
            ("key frames used", ", ".join(map(str, result.attrs["key_frames"]))),
            *(
                (f"key frame {frame} is not used", why)
                for frame, why in result.attrs["refused_key_frames"].items()
            ),
            ("tracking missed the next key frame by [px]", _numbers(result.attrs["drift"])),
            ("frames to click next", ", ".join(map(str, result.attrs["pick_next"]))),
            *(("chosen", decision) for decision in result.attrs["decisions"]),
            *(("look at it", reason) for reason in result.attrs["reasons"]),
        ]
        tables.append(Table(f"Broadcast camera of clip {clip}", ("", ""), tuple(rows)))
    return tables


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.2g}" for value in values) or "-"
