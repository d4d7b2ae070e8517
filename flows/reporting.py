"""The page about a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.evaluation import Evaluation
from flows.evaluation import load_reference, score
from flows.release import clips_of, joint_tracks, static_cameras
from flows.stage import Match
from worldpose.release import JointTracks, Picture, report_page, whole_file
from worldpose.release.pictures import paths_picture, view_picture
from worldpose.store import Run, Store, open_run


def write_report(
    store: Store, match: Match, out: Path, *, run_id: str = "latest", reference: str | None = None
) -> None:
    """Writes the HTML page of one run.

    Args:
        store: the project's store.
        match: the match.
        out: the file to write.
        run_id: number of the run.
        reference: truth; None = `reference/` of the match folder, where there is one.
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
    pictures = [picture for clip in clips for picture in _pictures(run, match, clip, truth)]
    page = report_page(
        f"{match.match_id}, run {run.record.run_id}",
        run.record,
        seconds=seconds,
        scores=scores,
        pictures=pictures,
    )
    with whole_file(out) as draft:
        draft.write_text(page, encoding="utf-8")


def _own_reference(match: Match) -> str | None:
    folder = match.folder.folder / "reference"
    return str(folder) if (folder / "joints.npz").is_file() else None


def _pictures(run: Run, match: Match, clip: str, truth: JointTracks | None) -> list[Picture]:
    """People from above, and the frame and camera in which most of them were seen."""
    cameras = static_cameras(run, match.folder.spec)
    tracks = joint_tracks(run, clip)
    pitch = match.folder.pitch
    above = paths_picture(tracks, truth=truth, cameras=cameras, pitch=pitch)
    pictures = [Picture(f"Clip {clip} from above.", above)]
    seen = run[f"triangulation/{clip}"]["inliers"].any("joint").sum("person").values
    if not seen.any():
        return pictures
    frame, camera = np.unravel_index(int(seen.argmax()), seen.shape)
    camera_id = list(cameras)[camera]
    number = int(tracks.frames[frame])
    view = view_picture(
        cameras[camera_id],
        f"camera {camera_id}, frame {number}",
        detections=run[f"ingest/{camera_id}"]["keypoints"].sel(frame=number).values,
        joints=tracks.joints[frame],
        person_ids=tracks.person_ids,
        pitch=pitch,
    )
    return [*pictures, Picture(f"The view with most people: {camera_id}, frame {number}.", view)]
