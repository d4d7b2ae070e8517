"""What a person is shown beside a question: pictures and tables of the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import Response

from data_contracts.review import ReviewRequest
from flows.broadcast_reporting import broadcast_pictures, broadcast_tables
from flows.camera_reporting import camera_evidence
from flows.pages.desk import Desk
from flows.people_reporting import adjustment_tables, body_tables
from flows.release import static_cameras
from flows.reporting import clip_pictures
from flows.stage import Match
from worldpose.release import JointTracks, Picture
from worldpose.release.pictures import paths_picture
from worldpose.release.report import Table
from worldpose.review import requests_by_id
from worldpose.store import Run, Store, open_run

KEPT: Final = 16
"""Questions whose pictures are kept in memory; one takes a second or two to draw."""


@dataclass(frozen=True)
class Evidence:
    """What belongs to one question."""

    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()


def routes(desk: Desk) -> APIRouter:
    """Routes of the evidence of one question."""
    router = APIRouter(prefix="/api/matches/{match_id}/reviews/{request}")
    drawn: dict[tuple[str, str], Evidence] = {}
    lock = Lock()

    def evidence_of(match_id: str, request: str) -> Evidence:
        match = desk.match(match_id)
        asked = requests_by_id(match.journal.records).get(request)
        if asked is None:
            raise HTTPException(404, "no such review")
        with lock:  # one drawing at a time: they take all the memory of their pictures
            if (match_id, request) not in drawn:
                while len(drawn) >= KEPT:
                    drawn.pop(next(iter(drawn)))
                drawn[match_id, request] = draw_evidence(desk.store, match, asked)
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
        }

    @router.get("/pictures/{number}")
    def picture(match_id: str, request: str, number: int) -> Response:
        pictures = evidence_of(match_id, request).pictures
        if not 0 <= number < len(pictures):
            raise HTTPException(404, "no such picture")
        return Response(pictures[number].png, media_type="image/png")

    return router


def draw_evidence(store: Store, match: Match, request: ReviewRequest) -> Evidence:
    """What a person should see before deciding on a question: of the run that asked it."""
    run = open_run(store.url, match.match_id, request.run_id)
    (unit,) = request.keys
    return _DRAWN.get(request.gate, _nothing)(store, run, match, unit.partition("/")[2])


def _camera(store: Store, run: Run, match: Match, camera: str) -> Evidence:
    if "point_inlier" not in run[f"static_calibration/{camera}"]:
        return Evidence()  # it was given
    cameras = static_cameras(run, match.folder.spec, "triangulation")
    png = camera_evidence(store, run, match, camera, cameras[camera])
    caption = (
        "The pitch as this camera projects it; clicks as circles, those that it does not rest on "
        "as crosses; below, the expected error on the ground."
    )
    return Evidence((Picture(caption, png),))


def _identities(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    result = run[f"tracking/{clip}"]
    tracks = JointTracks(
        frames=result["frame"].values,
        person_ids=result["person"].values.astype(np.int64),
        joints=result["joints"].values.astype(np.float64),
    )
    cameras = static_cameras(run, match.folder.spec, "triangulation")
    png = paths_picture(tracks, cameras=cameras, pitch=match.folder.pitch)
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
    columns = (">track that stops", ">that begins", "frames", "", ">cost")
    return Evidence((Picture("Everybody's way.", png),), (Table("Joins", columns, rows),))


def _clip(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    return Evidence(tuple(clip_pictures(run, match, clip)), tuple(body_tables(run, (clip,))))


def _adjustment(store: Store, run: Run, match: Match, unit: str) -> Evidence:
    return Evidence((), tuple(adjustment_tables(run)[:1]))  # the others are lists to choose from


def _broadcast(store: Store, run: Run, match: Match, clip: str) -> Evidence:
    return Evidence(tuple(broadcast_pictures(run, match)), tuple(broadcast_tables(run)))


def _nothing(store: Store, run: Run, match: Match, unit: str) -> Evidence:
    return Evidence()


_DRAWN: Final[dict[str, Callable[[Store, Run, Match, str], Evidence]]] = {
    "static_calibration": _camera,
    "tracking": _identities,
    "triangulation": _clip,
    "bundle_adjustment": _adjustment,
    "body_fitting": _clip,
    "broadcast_calibration": _broadcast,
}
