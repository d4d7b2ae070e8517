"""Evidence for a review request: images and tables of the result."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse, Response
from numpy.typing import NDArray

from data_contracts.review import ReviewRequest
from flows.reports.broadcast import broadcast_pictures, broadcast_tables
from flows.reports.cameras import camera_evidence, proposal_evidence
from flows.reports.clip_video import clip_view, write_clip_video
from flows.reports.clips import clip_pictures, detection_pictures
from flows.reports.people import adjustment_tables, body_tables
from flows.results.best_results import placed_joints, static_cameras
from flows.stage import Match
from flows.web.app_context import PageContext
from worldpose.formats.joints_file import JointTracks
from worldpose.reports.clips import plot_paths
from worldpose.reports.html_page import CaptionedImage, Table
from worldpose.review.evidence import Curve, clip_curves
from worldpose.review.journal import requests_by_id
from worldpose.store.store import Run, Store, open_run

CACHED_REVIEWS: Final = 16
"""Review requests whose images are kept in memory; drawing takes one or two seconds each."""

MOST_CAMERAS: Final = 4
"""Images of cameras that contradict the others; more than four are rarely wrong at once."""


@dataclass(frozen=True)
class Evidence:
    """Evidence for one review request."""

    pictures: tuple[CaptionedImage, ...] = ()
    tables: tuple[Table, ...] = ()
    curves: tuple[Curve, ...] = ()
    first_frame: int = 0
    video: str | None = None
    """Camera or clip whose video shows it; None if there is none."""
    clicked: tuple[str, ...] = ()
    """Static cameras whose clicks may be wrong."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the evidence for one review request."""
    router = APIRouter(prefix="/api/matches/{match_id}/reviews/{request}")
    drawn: dict[tuple[str, str], Evidence] = {}
    lock, filming = Lock(), Lock()
    videos = TemporaryDirectory(prefix="worldpose-pages-")

    def evidence_of(match_id: str, request: str) -> Evidence:
        match = context.match(match_id)
        asked = requests_by_id(match.journal.questions).get(request)
        if asked is None:
            raise HTTPException(404, "no such review")
        with lock:  # one at a time: drawing needs memory for all images
            if (match_id, request) not in drawn:
                while len(drawn) >= CACHED_REVIEWS:
                    drawn.pop(next(iter(drawn)))
                drawn[match_id, request] = draw_evidence(context.store, match, asked)
            return drawn[match_id, request]

    @router.get("/evidence")
    def evidence(match_id: str, request: str) -> dict[str, Any]:
        found = evidence_of(match_id, request)
        return {
            "pictures": [picture.caption for picture in found.pictures],
            "tables": [
                {"title": table.heading, "columns": table.columns, "rows": table.rows}
                for table in found.tables
            ],
            "curves": [
                {"title": curve.title, "values": _numbers(curve.values)} for curve in found.curves
            ],
            "first_frame": found.first_frame,
            "video": found.video,
            "clicked": found.clicked,
        }

    @router.get("/pictures/{number}")
    def picture(match_id: str, request: str, number: int) -> Response:
        pictures = evidence_of(match_id, request).pictures
        if not 0 <= number < len(pictures):
            raise HTTPException(404, "no such picture")
        return Response(pictures[number].png, media_type="image/png")

    @router.get("/video")
    def video(match_id: str, request: str) -> FileResponse:
        if evidence_of(match_id, request).video is None:
            raise HTTPException(404, "no camera of this clip has a video")
        match = context.match(match_id)
        asked = requests_by_id(match.journal.questions)[request]
        name = hashlib.sha256(f"{match_id} {request}".encode()).hexdigest()
        file = Path(videos.name) / f"{name}.mp4"
        with filming:
            if not file.is_file():
                run = open_run(context.store.url, match_id, asked.run_id)
                (unit,) = asked.keys
                draft = file.with_suffix(".draft.mp4")
                write_clip_video(context.store, run, match, unit.partition("/")[2], draft)
                draft.replace(file)
        return FileResponse(file, media_type="video/mp4")

    return router


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 5) for value in values]


def draw_evidence(store: Store, match: Match, request: ReviewRequest) -> Evidence:
    """Draw the evidence for a review request, from the run that created it."""
    run = open_run(store.url, match.match_id, request.run_id)
    (unit,) = request.keys
    return _DRAWN.get(request.gate, _no_evidence)(store, run, match, unit.partition("/")[2])


def _camera(store: Store, run: Run, match: Match, camera: str) -> Evidence:
    if "point_inlier" not in run[f"static_calibration/{camera}"]:
        # A given camera, or one that is left out.
        proposed = proposal_evidence(store, run, match, camera)
        return Evidence() if proposed is None else Evidence(proposed[:1], proposed[1:])
    cameras = static_cameras(run, match.folder.spec, "triangulation")
    png = camera_evidence(store, run, match, camera, cameras[camera])
    caption = (
        "The projected pitch. Circles are inlier clicks, crosses are outliers. Below: the expected "
        "error on the ground."
    )
    return Evidence((CaptionedImage(caption, png),))


def _consistency(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    """Draw the cameras that contradict the others; list their faults and what any two share."""
    result = run[f"camera_consistency/{clip}"]
    faults = result.attrs["faults"]
    named = list(dict.fromkeys(fault["camera"] for fault in faults))
    pictures = [
        replace(picture, caption=f"Camera {camera}. {picture.caption}")
        for camera in named[:MOST_CAMERAS]
        for picture in _camera(store, run, match, camera).pictures
    ]
    rows = tuple(
        (
            fault["camera"],
            fault["reason"],
            f"{fault['share_now']:.0%}",
            "" if fault["share_corrected"] is None else f"{fault['share_corrected']:.0%}",
        )
        for fault in faults
    )
    columns = ("camera", "fault", ">detections that agree", ">if corrected")
    cameras = [str(name) for name in result["camera"].values]
    agreement = tuple(
        (camera, *("" if k == c else f"{value:.1f}" for k, value in enumerate(row)))
        for c, (camera, row) in enumerate(
            zip(cameras, result["agreement"].values.tolist(), strict=True)
        )
    )
    tables = (
        Table("Cameras that contradict the others", columns, rows),
        Table(
            "People in a frame that two cameras agree on, above chance",
            ("camera", *(f">{camera}" for camera in cameras)),
            agreement,
        ),
    )
    clicked = tuple(camera for camera in named if camera in match.folder.clicked)
    return Evidence(tuple(pictures), tables, clicked=clicked)


def _identities(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    result = run[f"tracking/{clip}"]
    tracks = JointTracks(
        frames=result["frame"].values,
        person_ids=result["person"].values.astype(np.int64),
        joints=result["joints"].values.astype(np.float64),
    )
    cameras = static_cameras(run, match.folder.spec, "triangulation")
    png = plot_paths(tracks, cameras=cameras, pitch=match.folder.pitch)
    rows = tuple(
        (
            str(join["before"]),
            str(join["after"]),
            f"{join['last_frame']} to {join['first_frame']}",
            "joined" if join["decided"] else "undecided",
            f"{join['cost']:.1f}",
        )
        for join in result.attrs["joins"]
    )
    columns = (">track that ends", ">track that begins", "frames", "", ">cost")
    return Evidence(
        (CaptionedImage("The paths of all people.", png),), (Table("Joins", columns, rows),)
    )


def _clip(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    pictures = (
        *clip_pictures(store, run, match, clip),
        *detection_pictures(store, run, match, clip),
    )
    return Evidence(pictures, tuple(body_tables(run, (clip,))))


def _acceptance(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    """Draw a clip for release: images and tables, metrics over its frames, video."""
    fits, joints = run[f"body_fitting/{clip}"], placed_joints(run, clip)
    placed = joints["joints"].reindex(frame=fits["frame"].values, person=fits["person"].values)
    curves = clip_curves(
        fits["joints"].values.astype(np.float64),
        fits["covariance"].values,
        fits["filled"].values,
        placed.values.astype(np.float64),
    )
    shown = _clip(store, run, match, clip)
    first = int(fits["frame"].values[0]) if fits.sizes["frame"] else 0
    video = clip_view(run, match, clip)
    return replace(shown, curves=curves, first_frame=first, video=video)


def _adjustment(store: Store, run: Run, match: Match, unit: str) -> Evidence:
    return Evidence((), tuple(adjustment_tables(run)[:1]))  # the others are lists of edits


def _broadcast(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    return Evidence(tuple(broadcast_pictures(run, match)), tuple(broadcast_tables(run, match)))


def _no_evidence(store: Store, run: Run, match: Match, unit: str) -> Evidence:
    return Evidence()


_DRAWN: Final[dict[str, Callable[[Store, Run, Match, str], Evidence]]] = {
    "static_calibration": _camera,
    "camera_consistency": _consistency,
    "tracking": _identities,
    "triangulation": _clip,
    "bundle_adjustment": _adjustment,
    "body_fitting": _acceptance,
    "broadcast_calibration": _broadcast,
}
