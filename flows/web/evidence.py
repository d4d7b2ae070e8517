"""Evidence for a review request: images and tables of the result, and its outliers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse, Response
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from data_contracts.review import DeletedDetection, MovedKeypoint, MovedPoint, ReviewRequest
from flows.layers import pitch_of_run
from flows.reports.broadcast import broadcast_pictures, broadcast_tables
from flows.reports.cameras import camera_evidence, health_picture, proposal_evidence
from flows.reports.clip_video import clip_view
from flows.reports.clips import clip_pictures, detection_pictures
from flows.reports.match_pictures import frame_pictures
from flows.reports.people import adjustment_tables, body_tables
from flows.results.best_results import placed_joints
from flows.results.run_cameras import ADJUSTED, static_cameras
from flows.stage import Match
from flows.stages.detection import seen_by
from flows.web.app_context import PageContext
from flows.web.images import encode_image
from flows.web.results import DrawnFiles, footage_mark
from worldpose.errors import InputError
from worldpose.formats.joints_file import JointTracks
from worldpose.reports.clips import plot_paths
from worldpose.reports.html_page import CaptionedImage, Table
from worldpose.review.clicks import current_value
from worldpose.review.evidence import Curve, clip_curves
from worldpose.store.store import Run, Store

CACHED_REVIEWS: Final = 16
"""Review requests whose images are kept in memory; drawing takes one or two seconds each."""

CURVE_VALUES: Final = 4000
"""Values of a curve that are sent; a plot is not as wide."""

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
    lock, videos = Lock(), DrawnFiles()

    @lru_cache(CACHED_REVIEWS)
    def draw(match_id: str, request: str, shows: str) -> Evidence:
        return draw_evidence(context.store, *context.review(match_id, request))

    def evidence_of(match_id: str, request: str) -> Evidence:
        with lock:  # one at a time: drawing needs memory for all images
            return draw(match_id, request, footage_mark(context.match(match_id)))

    @router.get("/evidence")
    def evidence(match_id: str, request: str) -> dict[str, Any]:
        found = evidence_of(match_id, request)
        count = max((len(curve.values) for curve in found.curves), default=1)
        every = max(1, -(-count // CURVE_VALUES))
        return {
            "pictures": [picture.caption for picture in found.pictures],
            "tables": [
                {"title": table.heading, "columns": table.columns, "rows": table.rows}
                for table in found.tables
            ],
            "curves": [
                {"title": curve.title, "values": _numbers(thin_curve(curve.values, every))}
                for curve in found.curves
            ],
            "frames_per_value": every,
            "first_frame": found.first_frame,
            "last_frame": found.first_frame + count - 1,
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
        match, asked = context.review(match_id, request)
        run = asked_run(context.store, asked)
        (unit,) = asked.keys
        return videos.clip_video(context.store, run, match, unit.partition("/")[2])

    _add_outliers(router, context)
    return router


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 5) for value in values]


def thin_curve(values: NDArray[np.float64], every: int) -> NDArray[np.float64]:
    """Thin values (n,) to the least and largest of each 2 * `every`, in order; NaN without any.

    A gap that covers no such stretch is not in the curve: it is narrower than a pixel of its plot.
    """
    if every <= 1:
        return values
    padded = np.pad(values, (0, -len(values) % (2 * every)), constant_values=np.nan)
    bins = padded.reshape(-1, 2 * every)
    gone = np.isnan(bins)
    least = np.where(gone, np.inf, bins).argmin(axis=1)
    largest = np.where(gone, -np.inf, bins).argmax(axis=1)
    order = np.sort(np.stack([least, largest], axis=1), axis=1)
    return np.take_along_axis(bins, order, axis=1).ravel()


def draw_evidence(store: Store, match: Match, request: ReviewRequest) -> Evidence:
    """Draw the evidence for a review request, from the newest run with the results under review.

    A table says which videos are not at hand: their images are not among it.
    """
    draw = _DRAWN.get(request.gate)
    if draw is None:
        return Evidence()
    run, there = asked_run(store, request), match.at_hand()
    (unit,) = request.keys
    found = draw(store, run, there, unit.partition("/")[2])
    gone = [(name,) for name in match.folder.videos if name not in there.folder.videos]
    said = (Table("Videos that are not at hand: their images are not shown", ("",), tuple(gone)),)
    return replace(found, tables=(*found.tables, *(said if gone else ())))


def asked_run(store: Store, request: ReviewRequest) -> Run:
    """Open the newest run that has the results under review, or InputError.

    The run that asked may have been killed before its record was stored, or removed since.
    """
    for run_id in reversed(store.runs(request.match_id)):
        record = store.run(request.match_id, run_id)
        if request.keys.items() <= record.results.items():
            return Run(store, record)
    raise InputError(
        f"review {request.id}",
        expected=f"a run with the results under review, {', '.join(request.keys)}",
        found="none",
        todo="Run the match again: if its results need review, it asks about them.",
    )


def _camera(store: Store, run: Run, match: Match, camera: str) -> Evidence:
    if "point_inlier" not in run[f"static_calibration/{camera}"]:
        # A given camera, or one that is left out.
        proposed = proposal_evidence(store, run, match, camera)
        return Evidence() if proposed is None else Evidence(proposed[:1], proposed[1:])
    cameras = static_cameras(run, match.folder.spec, "triangulation")
    png = camera_evidence(store, run, match, camera, cameras[camera])
    caption = (
        "The projected pitch. Circles are clicks that agree, crosses are clicks that contradict "
        "them and are not used. Below: the expected error on the ground."
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
    joints = result["joints"].values.astype(np.float64)
    if "ground" in result:
        by_feet = np.isnan(joints).all(axis=(-2, -1))
        place = result["ground"].values[by_feet][:, None]
        joints[by_feet] = np.concatenate([place, 0.0 * place[..., :1]], axis=-1)
    tracks = JointTracks(
        frames=result["frame"].values,
        person_ids=result["person"].values.astype(np.int64),
        joints=joints,
    )
    cameras = static_cameras(run, match.folder.spec, "triangulation")
    png = plot_paths(tracks, cameras=cameras, pitch=pitch_of_run(run, lambda: match.folder.pitch))
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
        *health_picture(run, match, clip),
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
    cameras = [str(name) for name in run[ADJUSTED]["camera"].values]
    pictures = [
        replace(picture, caption=f"Camera {camera}, as it was before. {picture.caption}")
        for camera in cameras[:MOST_CAMERAS]
        for picture in _camera(store, run, match, camera).pictures
    ]
    # The other tables are lists of edits.
    return Evidence(tuple(pictures), tuple(adjustment_tables(run)[:1]))


def _people(store: Store, run: Run, match: Match, unit: str) -> Evidence:
    """Draw the boxes in the frames with the fewest, a middling and the largest number of people."""
    import cv2  # imported here: few pages decode an image

    result = run[f"detection/{unit}"]
    boxes, frames = result["boxes"].values, result["frame"].values
    counts = np.isfinite(boxes).all(axis=2).sum(axis=1)
    order = np.argsort(counts, kind="stable")
    rows = sorted({int(order[0]), int(order[len(order) // 2]), int(order[-1])})
    owner = unit if unit in match.folder.videos else unit.rpartition(".")[0]
    pictures = []
    for row, picture in zip(
        rows, frame_pictures(store, match, owner, [int(frames[r]) for r in rows]), strict=True
    ):
        if picture is None:
            continue
        drawn = np.ascontiguousarray(picture)
        for x0, y0, x1, y1 in boxes[row][np.isfinite(boxes[row]).all(axis=1)].round().astype(int):
            cv2.rectangle(drawn, (x0, y0), (x1, y1), (255, 213, 74), max(2, drawn.shape[1] // 700))
        caption = f"{owner}, frame {frames[row]}: {counts[row]} people detected."
        pictures.append(CaptionedImage(caption, encode_image(drawn, "png")))
    return Evidence(tuple(pictures))


_DRAWN: Final[dict[str, Callable[[Store, Run, Match, str], Evidence]]] = {
    "static_calibration": _camera,
    "detection": _people,
    "camera_consistency": _consistency,
    "tracking": _identities,
    "triangulation": _clip,
    "bundle_adjustment": _adjustment,
    "body_fitting": _acceptance,
    "broadcast_calibration": lambda _, run, match, view: Evidence(
        tuple(broadcast_pictures(run, match, view)), tuple(broadcast_tables(run, match, view))
    ),
}


MAX_LISTED: Final = 60
"""Maximum number of listed keypoints, by largest Mahalanobis distance."""
Outlier = tuple[float, str, MovedPoint | MovedKeypoint | DeletedDetection, bool]
"""Mahalanobis distance [standard deviations], subject, edit that removes it, and whether it is
already removed."""


def _add_outliers(router: APIRouter, context: PageContext) -> None:
    """Add the route of the adjustment's outliers, each with the edit that removes it."""

    @router.get("/outliers")
    def outliers(match_id: str, request: str) -> list[dict[str, Any]]:
        match, asked = context.review(match_id, request)
        run = asked_run(context.store, asked)
        if ADJUSTED not in asked.keys or ADJUSTED not in run:
            return []
        return [
            {
                "surprise": round(surprise, 1) if math.isfinite(surprise) else None,
                "of": of,
                "edit": edit.model_dump(mode="json"),
                "out": out,
            }
            for surprise, of, edit, out in (*_clicks(run, match), *_keypoints(run, match))
        ]


def _clicks(run: Run, match: Match) -> Iterator[Outlier]:
    """Yield clicked points proposed for removal."""
    result = run[ADJUSTED]
    names = [str(name) for name in result["camera"].values]
    for k in np.flatnonzero(result["click_wrong"].values):
        camera = names[int(result["click_camera"].values[k])]
        marking = str(result["click"].values[k])
        edit = MovedPoint(camera=camera, marking=marking, xy=None)
        was = current_value(match.folder, edit)
        surprise = float(result["click_surprise"].values[k])
        yield surprise, "click", edit.model_copy(update={"was": was}), was is None


def _keypoints(run: Run, match: Match) -> Iterator[Outlier]:
    """Yield keypoints, and people in one image, that are outliers to the other cameras."""
    result = run[ADJUSTED]
    names = [str(name) for name in result["camera"].values]
    said = {_place(correction.edit) for correction in match.corrections}
    for k in range(min(MAX_LISTED, result.sizes["outlier"])):
        frame, c, person, joint = (
            int(result[f"outlier_{name}"].values[k])
            for name in ("frame", "camera", "person", "joint")
        )
        clip = match.folder.spec.clips_with(frame)[0].id
        tracks = run[f"tracking/{clip}"].sel(frame=frame, person=person)
        detection = int(tracks["detection_index"].values[c])
        seen = run[seen_by(match, names[c], clip)]
        # The next iteration repeats redetection: these people need no correction.
        if not 0 <= detection < seen.sizes["detection"]:
            continue
        place = {"camera": names[c], "frame": frame, "detection": detection}
        edit: MovedKeypoint | DeletedDetection
        if joint < 0:
            box = seen["boxes"].sel(frame=frame).values[detection]
            was = tuple(map(float, box)) if np.isfinite(box).all() else None
            edit = DeletedDetection(**place, was=was)
        else:
            pixel = seen["keypoints"].sel(frame=frame).values[detection, joint]
            x, y = (float(value) for value in pixel)
            edit = MovedKeypoint(**place, joint=COCO17[joint], was=(x, y), xy=None)
        surprise = float(result["outlier_surprise"].values[k])
        yield surprise, f"person {person}", edit, _place(edit) in said


def _place(edit: object) -> tuple[object, ...]:
    """Return the target of a detection edit."""
    names = ("kind", "camera", "frame", "detection", "joint")
    return tuple(getattr(edit, name, None) for name in names)
