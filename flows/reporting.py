"""The page about a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.evaluation import Evaluation
from flows.broadcast_reporting import (
    broadcast_pictures,
    broadcast_tables,
    write_broadcast_videos,
)
from flows.camera_reporting import camera_pictures, camera_summaries, still_of
from flows.detection import seen_by
from flows.evaluation import load_reference, score
from flows.people_reporting import adjustment_tables, body_tables
from flows.release import bodies_unit, clips_of, joint_tracks, placed_joints, static_cameras
from flows.stage import Match
from worldpose.body import BodyParameters, find_body
from worldpose.cameras import Camera
from worldpose.release import JointTracks, Picture, report_page, whole_file
from worldpose.release.body_pictures import bodies_picture
from worldpose.release.pictures import paths_picture, view_picture
from worldpose.release.stadium_pictures import camera_picture, stadium_picture
from worldpose.store import Run, Store, open_run


def write_report(
    store: Store,
    match: Match,
    out: Path,
    *,
    run_id: str = "latest",
    reference: str | None = None,
    videos: bool = True,
) -> list[Path]:
    """Writes the HTML page of one run, and returns the videos written beside it.

    Args:
        store: the project's store.
        match: the match.
        out: the file to write.
        run_id: number of the run.
        reference: truth; None = `reference/` of the match folder, where there is one.
        videos: write each clip's broadcast video with what was found drawn over it.
    """
    run = open_run(store.url, match.match_id, run_id)
    clips = clips_of(run.record)
    source = reference or _own_reference(match)
    truth = None if source is None else load_reference(source)
    scores: Evaluation | None = None
    if source is not None and len(clips) == 1:
        scores = score(match.match_id, source, store.url, run_id=run_id).evaluation
    seconds = {}
    for name, key in run.record.results.items():
        stage, _, unit = name.partition("/")
        seconds[name] = store.manifest(match.match_id, stage, unit, key).seconds
    cameras = static_cameras(run, match.folder.spec)
    page = report_page(
        f"{match.match_id}, run {run.record.run_id}",
        run.record,
        seconds=seconds,
        scores=scores,
        pictures=[
            *(picture for clip in clips for picture in clip_pictures(run, match, clip, truth)),
            *broadcast_pictures(run, match),
        ],
        cameras=camera_summaries(run, match.folder.spec),
        camera_pictures=camera_pictures(store, run, match, cameras),
        tables=[*adjustment_tables(run), *body_tables(run, clips), *broadcast_tables(run, match)],
    )
    with whole_file(out) as draft:
        draft.write_text(page, encoding="utf-8")
    return write_broadcast_videos(run, match, out) if videos else []


def _own_reference(match: Match) -> str | None:
    folder = match.folder.folder / "reference"
    return str(folder) if (folder / "joints.npz").is_file() else None


def clip_pictures(
    run: Run, match: Match, clip: str, truth: JointTracks | None = None
) -> list[Picture]:
    """The stadium from a camera and from above, people's ways, and the view with most people."""
    cameras = static_cameras(run, match.folder.spec)
    tracks = joint_tracks(run, clip)
    pitch = match.folder.pitch
    seen = placed_joints(run, clip)["inliers"].any("joint").sum("person").values
    pictures = []
    if len(tracks.frames):
        first = int(tracks.frames[0])
        widest = list(cameras)[int(seen[0].argmax())]
        still = still_of(match, widest)
        here = f"Clip {clip}, frame {first}"
        beneath = "" if still is None else ", over its still"
        pictures = [
            Picture(
                f"{here}, from camera {widest}: markings and people as the found cameras and "
                f"joints put them{beneath}.",
                camera_picture(
                    cameras[widest], f"camera {widest}", tracks, 0, still=still, pitch=pitch
                ),
            ),
            Picture(
                f"{here}, from above. The more cameras see a place, the darker it is.",
                stadium_picture(cameras, "", tracks, 0, pitch=pitch),
            ),
        ]
        if bodies_unit(run, clip) in run:
            pictures.append(_bodies(run, match, clip, widest, cameras[widest]))
    above = paths_picture(tracks, truth=truth, cameras=cameras, pitch=pitch)
    pictures.append(Picture(f"Clip {clip}: everybody's way.", above))
    if not seen.any():
        return pictures
    frame, camera = np.unravel_index(int(seen.argmax()), seen.shape)
    camera_id = list(cameras)[camera]
    number = int(tracks.frames[frame])
    view = view_picture(
        cameras[camera_id],
        f"camera {camera_id}, frame {number}",
        detections=run[seen_by(match, camera_id, clip)]["keypoints"].sel(frame=number).values,
        joints=tracks.joints[frame],
        person_ids=tracks.person_ids,
        pitch=pitch,
    )
    return [*pictures, Picture(f"The view with most people: {camera_id}, frame {number}.", view)]


def _bodies(run: Run, match: Match, clip: str, camera_id: str, camera: Camera) -> Picture:
    """The bodies of a clip's first frame over a camera's still."""
    fits = run[bodies_unit(run, clip)]
    model = find_body(fits.attrs["body_model"])
    poses = BodyParameters(
        fits["betas"].values,
        *(fits[name].values[0] for name in ("global_orient", "body_pose", "transl")),
    )
    frame, still = int(fits["frame"].values[0]), still_of(match, camera_id)
    png = bodies_picture(
        camera,
        f"camera {camera_id}, frame {frame}",
        model.vertices(poses),
        model.faces,
        fits["person"].values,
        still=still,
        pitch=match.folder.pitch,
    )
    return Picture(
        f"Clip {clip}, frame {frame}: fitted bodies ({model.name}) where camera {camera_id} shows "
        f"most people{'' if still is None else ', over its still'}.",
        png,
    )
