"""Report section about the broadcast camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image, Integers
from data_contracts.broadcast_calibration import FRAME_STATUS
from flows.reports.match_pictures import shown_pitch
from flows.results.best_results import body_tracks, clip_title, joint_tracks
from flows.results.run_cameras import broadcast_cameras, broadcast_unit, clip_of
from flows.stage import Match
from worldpose.broadcast_calibration.given_camera import GivenCamera
from worldpose.broadcast_calibration.report import camera_before
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.tracking import follow, modified_z_scores
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.geometry.pan_tilt import camera_angles
from worldpose.ingest.camera_data import read_given_camera
from worldpose.ingest.footage import image_clock, unit_frames
from worldpose.reports.broadcast import (
    largest_pose_changes,
    plot_before_after,
    plot_camera_course,
    plot_flow,
)
from worldpose.reports.clips import plot_camera_view
from worldpose.reports.html_page import CaptionedImage, Table
from worldpose.reports.videos import overlay_frames
from worldpose.store.store import Run
from worldpose.video.files import write_video
from worldpose.video.folder import open_video, pictures_at

WORST_FRAMES: Final = 2
"""Number of frames shown with the largest camera uncertainty [1]."""
FRAME_RATE: Final = 25.0
"""Maximum frame rate of overlay videos, approximate [1/s]."""
MAX_VIDEO_S: Final = 30.0
"""Maximum duration of overlay videos [s]."""


def broadcast_pictures(run: Run, match: Match, clip: str | None = None) -> list[CaptionedImage]:
    """Plot each broadcast camera over time, and its frames of largest uncertainty.

    None = of all clips; in place of a clip, the name of one broadcast view is possible.
    """
    pictures = []
    for view, camera in broadcast_cameras(run, clip).items():
        result, clock = run[f"broadcast_calibration/{view}"], image_clock(match.folder.spec, view)
        frame, expected = result["frame"].values, result["reprojection_error"].values
        given: dict[str, Floats] | None = None
        if (data := match.folder.camera_data.get(view)) is not None:
            stated = read_given_camera(match.folder, view, data)
            values = GivenCamera.of(stated, clock.number).values
            names = ("pan [deg]", "tilt [deg]", "roll [deg]", "focal length [px]", "k1", "k2")
            given = dict(zip(names, values[:, [0, 1, 2, 6, 7, 8]].T, strict=True))
        pictures.append(
            CaptionedImage(
                f"{clip_title(view)}: the broadcast camera over its frames, smoothed (blue, with "
                "bands of two standard deviations) and each frame on its own (orange)"
                f"{', and camera data (dashed)' if given else ''}.",
                plot_camera_course(
                    frame,
                    camera,
                    run[broadcast_unit(run, view)]["covariance"].values,
                    camera_before(result.data_vars),
                    given,
                ),
            )
        )
        if not np.isfinite(expected).any():
            continue
        tracks = joint_tracks(run, clip_of(run, view))
        pictures += _before_and_after(run, match, view, tracks)
        pictures += flow_pictures(run, match, view, camera)
        for video_number in result.attrs["pick_next"][:WORST_FRAMES]:
            # An image between two match frames has no camera: the nearest one that has is drawn.
            place = int(np.abs(clock.number - video_number).argmin())
            number, video_number = int(frame[place]), int(clock.number[place])
            still = _picture(match, view, number)
            pictures.append(
                CaptionedImage(
                    f"{clip_title(view)}, frame {number}, {video_number} of its video, among those "
                    f"where the broadcast camera is known least ({expected[place]:.2g} px): "
                    "markings and people as it projects them.",
                    plot_camera_view(
                        camera[place],
                        f"broadcast camera, frame {number}",
                        tracks,
                        int(np.searchsorted(tracks.frames, number)),
                        still=still,
                        pitch=shown_pitch(run, match, view),
                    ),
                )
            )
    return pictures


def _before_and_after(
    run: Run, match: Match, view: str, tracks: JointTracks
) -> list[CaptionedImage]:
    """Crop the person that player refinement moved most, before and after; else empty."""
    result = run[f"broadcast_calibration/{view}"]
    if result.attrs["players_off"][1] is None:
        return []
    frame = result["frame"].values
    both = np.intersect1d(frame, tracks.frames)
    before, after = (
        whole[np.searchsorted(frame, both)]
        for whole in (camera_before(result.data_vars), camera_from_arrays(result.data_vars))
    )
    joints = tracks.joints[np.searchsorted(tracks.frames, both)]
    shared = JointTracks(both, tracks.person_ids, joints)
    if not joints.size:
        return []
    place, person = largest_pose_changes(before, after, shared)
    number = int(both[place])
    (detected,) = _seen_in(run, view)
    markings, players = (
        "{:.2f} and {:.2f}".format(*result.attrs[name]) for name in ("markings_off", "players_off")
    )
    return [
        CaptionedImage(
            f"{clip_title(view)}, frame {number}: before and after players and all frames "
            "together. Crosses: detected keypoints. Median errors: markings "
            f"{markings} px, people {players} px.",
            plot_before_after(
                before[place],
                after[place],
                shared,
                place,
                person,
                still=_picture(match, view, number),
                seen=run[detected].sel(frame=number)["keypoints"].values,
                pitch=shown_pitch(run, match, view),
            ),
        )
    ]


def _seen_in(run: Run, view: str) -> list[str]:
    """Return the result of a run with a view's detections; its video may be gone since."""
    names = f"detection/{view}", f"ingest/{view}"
    return [name for name in names if name in run and "boxes" in run[name]][:1]


def _picture(match: Match, view: str, frame: int) -> Image | None:
    """Return a view's image as `_pictures` yields it; None if its video is gone."""
    there = view in match.folder.videos
    return next(_pictures(match, view, np.array([frame]))) if there else None


def _pictures(match: Match, view: str, frames: Integers) -> Iterator[Image]:
    """Yield a view's images (height, width, 3) RGB at match frames; black where it has none."""
    spec, path = match.folder.spec, match.folder.videos[view]
    clock = unit_frames(spec, view)
    with open_video(path) as video:
        black = np.zeros((*video.index.size[::-1], 3), dtype=np.uint8)
        shown = video.index.shown(clock.numbers(frames), spec.fps * clock.rate, str(path))
        for picture in pictures_at(video, shown):
            yield black if picture is None else picture


def write_broadcast_video(run: Run, match: Match, view: str, file: Path) -> None:
    """Write a broadcast video with markings and people overlaid.

    The video has half the size and at most 25 frames per second. A clip of more than 30 s is cut to
    the 30 s around the frame with the largest camera uncertainty.
    """
    every = video_step(match)
    chosen = broadcast_video_frames(run, match, view)
    frames = run[f"broadcast_calibration/{view}"]["frame"].values[chosen]
    clip = clip_of(run, view)
    with whole_file(file) as draft:
        drawn = overlay_frames(
            _pictures(match, view, frames),
            broadcast_cameras(run, view)[view][chosen],
            joint_tracks(run, clip),
            frames,
            shown_pitch(run, match, view),
            body_tracks(run, clip),
        )
        write_video(draft, drawn, match.folder.spec.fps / every, quality=23)


def video_step(match: Match) -> int:
    """Return the step of the frames of an overlay video."""
    return max(1, round(match.folder.spec.fps / FRAME_RATE))


def broadcast_video_frames(run: Run, match: Match, view: str) -> Integers:
    """Return the indices of the frames of a view's video: the part of the largest error."""
    expected = np.nan_to_num(run[f"broadcast_calibration/{view}"]["reprojection_error"].values)
    most = round(MAX_VIDEO_S * match.folder.spec.fps)
    begin = int(np.clip(int(expected.argmax()) - most // 2, 0, max(0, len(expected) - most)))
    return np.arange(begin, min(begin + most, len(expected)), video_step(match))


def broadcast_tables(run: Run, match: Match, clip: str | None = None) -> list[Table]:
    """Tabulate the evidence of each broadcast view's frames, and the warnings for a reviewer."""
    tables = []
    for view, camera in broadcast_cameras(run, clip).items():
        result = run[f"broadcast_calibration/{view}"]
        status = np.bincount(result["status"].values, minlength=len(FRAME_STATUS))
        pan, _, _ = camera_angles(camera)
        rows = [
            *(
                (f"frames that rest on: {name.replace('_', ' ')}", str(count))
                for name, count in zip(FRAME_STATUS, status, strict=True)
                if count
            ),
            ("key frames used, of its video", ", ".join(map(str, result.attrs["key_frames"]))),
            *(
                (f"key frame {frame} is not used", why)
                for frame, why in result.attrs["refused_key_frames"].items()
            ),
            ("length [s]", f"{len(pan) / match.folder.spec.fps:.1f}"),
            ("pan, from leftmost to rightmost [deg]", f"{np.nanmax(pan) - np.nanmin(pan):.1f}"),
            *(
                (f"{name} miss by, before and after players [px]", _numbers(result.attrs[key]))
                for name, key in (("markings", "markings_off"), ("people", "players_off"))
                if None not in result.attrs[key]
            ),
            ("tracking missed the next key frame by [px]", _numbers(result.attrs["drift"])),
            ("frames of its video to click next", ", ".join(map(str, result.attrs["pick_next"]))),
            *(("chosen", decision) for decision in result.attrs["decisions"]),
            *_pooling_rows(run, view),
            *(("look at it", reason) for reason in result.attrs["reasons"]),
        ]
        tables.append(Table(clip_title(view), ("", ""), tuple(rows)))
    return tables


def _pooling_rows(run: Run, view: str) -> list[tuple[str, str]]:
    """Return the agreement of the camera position with its other clips, if there are any."""
    pooled = run[broadcast_unit(run, view)].attrs
    if "distance" not in pooled:
        return []
    apart = ", ".join(
        f"{name} {distance:.1f}"
        for name, distance in zip(pooled["clips"], pooled["distance"], strict=True)
    )
    said = "one place" if pooled["agree"] else "no common place: each clip keeps its own"
    return [("the camera's clips have", f"{said}; from it [standard deviations]: {apart}")]


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.2g}" for value in values) or "-"


def flow_pictures(run: Run, match: Match, view: str, camera: Camera) -> list[CaptionedImage]:
    """Draw points tracked between the two frames with the largest rotation of the camera.

    The camera is a batch over the frames of its clip; nothing without the video.
    """
    if view not in match.folder.videos:
        return []
    frames = run[f"broadcast_calibration/{view}"]["frame"].values
    rotation = camera.cam_from_world.rotation
    # The angle of R1^T R2 increases as the trace decreases.
    traces = np.einsum("fab,fab->f", rotation[1:], rotation[:-1])
    known = np.isfinite(traces) & (np.diff(frames) == 1)
    if not known.any():
        return []
    pair = int(np.argmin(np.where(known, traces, np.inf)))
    number = int(frames[pair])
    stills = list(_pictures(match, view, frames[pair : pair + 2]))
    boxes = None
    for unit in _seen_in(run, view):
        boxes = run[unit]["boxes"].sel(frame=[number]).values.astype(np.float64)
    own = run.record.settings.get("broadcast_calibration", {})
    settings = BroadcastCalibrationSettings.model_validate(own)
    greys = [np.asarray(cv2.cvtColor(still, cv2.COLOR_RGB2GRAY), np.uint8) for still in stills]
    (followed,) = follow(greys, boxes, settings.flow_points)
    rays = camera[pair].unproject(followed.start)
    predicted = camera[pair + 1].project(rays.origins + rays.directions * 100.0)
    told = np.isfinite(predicted).all(-1)
    start, end, predicted = followed.start[told], followed.end[told], predicted[told]
    rejected = modified_z_scores(predicted - end) >= settings.flow_outlier
    png = plot_flow(stills[0], start, end, rejected, predicted)
    return [
        CaptionedImage(
            f"{clip_title(view)}, frame {number}, where the camera turns most from one frame to "
            "the next: points of the background where the next frame has them (arrows), those "
            "that do not move with the others (orange), and where the estimated camera projects "
            "them (yellow).",
            png,
        )
    ]
