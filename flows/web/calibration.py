"""Clicking markings in an image: clicks, image, and the camera estimated from them."""

from __future__ import annotations

import gc
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import JSONResponse, Response
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.arrays import Image
from data_contracts.cameras import CameraCalibration
from data_contracts.match import Side
from data_contracts.pitch import PitchSpec
from data_contracts.records import Name, Record
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking, Pixel
from flows.gates import GATES
from flows.review.verdicts import reviews_of
from flows.run_record import latest_run
from flows.stage import Match
from flows.web.app_context import PageContext
from flows.web.browser_words import describe_error
from flows.web.images import encode_image, file_mark
from worldpose.errors import InputError, WorldposeError
from worldpose.geometry.cameras import Camera
from worldpose.ingest.footage import read_still, unit_frames
from worldpose.pitch.template import PitchTemplate
from worldpose.review.evidence import PitchDrawing, Preview, preview
from worldpose.review.journal import MOST_KEPT
from worldpose.static_calibration.from_paint.proposal import propose_camera
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.video.folder import open_video

CACHED_IMAGES: Final = 2
"""Images that are kept decoded; a 4K one takes 25 MB."""
_POINTS_ALONE: Final = StaticCalibrationSettings(lines=False)


class Clicked(Record):
    """All clicks in one image, as sent by the page."""

    points: dict[Name, Pixel] = Field(default={}, max_length=200)
    """Point name to position [px]."""
    drawn: dict[Name, tuple[Pixel, ...]] = Field(default={}, max_length=100)
    """Line name to positions along it [px]."""
    refine: bool = False
    """Refine on the painted lines of the image: seconds, not milliseconds."""

    def markings(self) -> ClickedMarkings:
        """Return the clicks as a file of the match folder has them."""
        drawn = ((name, xy) for name, xy in sorted(self.drawn.items()) if xy)
        return ClickedMarkings(
            points=tuple(ClickedPoint(name=n, xy=xy) for n, xy in sorted(self.points.items())),
            drawn=tuple(DrawnMarking(name=name, xy=xy) for name, xy in drawn),
        )


GROUND_LIMIT_M: Final = GATES["static_calibration"].limits["expected_ground_error_median_m"]
"""Expected error on the pitch above which a run asks about a camera [m]."""


class Wanted(Record):
    """A request for markings without clicks."""

    side: Side = "near"
    """Side of the pitch on which the camera stands."""


class Pictures:
    """Cache of the images decoded last, on which users click."""

    def __init__(self) -> None:
        self._decoded: OrderedDict[tuple[object, ...], NDArray[np.uint8]] = OrderedDict()
        self._lock = Lock()

    def png(self, match: Match, owner: str, frame: int | None) -> bytes:
        """Return one image as PNG, or HTTPException 404."""
        if frame is None and owner in match.folder.stills:
            return _find_picture(match, owner, frame).read_bytes()
        return encode_image(self.decode_image(match, owner, frame), "png")

    def decode_image(self, match: Match, owner: str, frame: int | None) -> NDArray[np.uint8]:
        """Return one image (height, width, 3), RGB, or HTTPException 404."""
        file = _find_picture(match, owner, frame)
        name = (match.match_id, owner, frame, file_mark(file))
        with self._lock:
            if name not in self._decoded:
                self._decoded[name] = _read(match, owner, frame, file)
            self._decoded.move_to_end(name)
            while len(self._decoded) > CACHED_IMAGES:
                self._decoded.popitem(last=False)
            return self._decoded[name]


def routes(context: PageContext) -> APIRouter:
    """Create the routes of one image: of a static camera, or of a frame of a broadcast camera."""
    router = APIRouter(prefix="/api/matches/{match_id}/pictures/{owner}")
    pictures = Pictures()
    drawings: dict[str, tuple[PitchSpec, PitchDrawing]] = {}

    def open_camera(match_id: str, owner: str) -> tuple[Match, tuple[int, int]]:
        """Return a match, and the size of the camera's images."""
        match = context.match(match_id)
        camera = match.folder.spec.filming_camera(owner)
        if camera is None:
            raise HTTPException(404, "no such camera")
        return match, (camera.width, camera.height)

    def open_picture(match_id: str, owner: str) -> tuple[Match, PitchDrawing, tuple[int, int]]:
        """Return a match, its pitch as it is now, and the size of the camera's images."""
        match, size = open_camera(match_id, owner)
        pitch = match.folder.pitch
        if pitch is None:
            raise HTTPException(404, "the match has no pitch")
        if match_id not in drawings or drawings[match_id][0] != pitch:
            drawings[match_id] = pitch, PitchDrawing(PitchTemplate.from_spec(pitch))
        return match, drawings[match_id][1], size

    @router.get("")
    def picture(match_id: str, owner: str, frame: int | None = None) -> dict[str, Any]:
        match, size = open_camera(match_id, owner)
        given = match.folder.calibrations.get(owner)
        seen: dict[str, Any] = {"pitch": None, "markings": {}}
        if match.folder.pitch is not None:
            drawing = open_picture(match_id, owner)[1]
            seen["pitch"] = _pitch(drawing)
            if given is not None:
                pieces = drawing.project_markings(Camera.from_calibration(given))
                seen["markings"] = _round_pieces(pieces)
        pose = None if given is None else _describe_pose(given)
        return {**seen, "size": size, "pose": pose, **_describe(context, match, owner, frame)}

    @router.get("/image")
    def image(match_id: str, owner: str, frame: int | None = None) -> Response:
        content = pictures.png(open_camera(match_id, owner)[0], owner, frame)
        return Response(content, media_type="image/png")

    @router.post("/preview")
    def estimate(
        match_id: str, owner: str, clicked: Clicked, frame: int | None = None
    ) -> JSONResponse:
        match, drawing, size = open_picture(match_id, owner)
        markings, spec = clicked.markings(), match.folder.spec.filming_camera(owner)
        try:
            found = preview(
                drawing,
                markings,
                size,
                picture=pictures.decode_image(match, owner, frame) if clicked.refine else None,
                settings=StaticCalibrationSettings() if clicked.refine else _POINTS_ALONE,
                lens=match.folder.lenses.get(owner),
                side=None if spec is None else spec.side,
            )
        except InputError as error:
            advice = {"camera": None, "expected": error.expected, "todo": error.todo}
            return JSONResponse(advice)
        if frame is None:
            ground = found.report.ground_error
            errors = {
                "expected_ground_error_median_m": float(ground.median),
                "expected_ground_error_p95_m": float(ground.p95),
            }
            context.previews[match_id, owner] = markings, errors
        return JSONResponse(_answer(found))

    @router.post("/proposal")
    def propose(
        match_id: str, owner: str, wanted: Wanted, frame: int | None = None
    ) -> dict[str, Any]:
        match, drawing, _ = open_picture(match_id, owner)
        return _propose(match, drawing, owner, pictures.decode_image(match, owner, frame), wanted)

    return router


def _describe(context: PageContext, match: Match, owner: str, frame: int | None) -> dict[str, Any]:
    """Return clicks, metrics and review requests of one image."""
    clicked = _read_clicks(match, owner, frame)
    latest = latest_run(context.store, match.match_id)
    stage = "static_calibration" if frame is None else "broadcast_calibration"
    unit, spec = f"{stage}/{owner}", match.folder.spec.filming_camera(owner)
    return {
        "match": match.match_id,
        "owner": owner,
        "frame": frame,
        "given": owner in match.folder.calibrations,
        "side": None if spec is None else spec.side,
        "has_picture": owner in match.folder.stills or owner in match.folder.videos,
        "points": {point.name: point.xy for point in clicked.points},
        "drawn": {marking.name: marking.xy for marking in clicked.drawn},
        "figures": {} if latest is None else latest.figures.get(unit, {}),
        "reviews": [
            {"id": each.request.id, "state": each.state, "reasons": each.request.reasons}
            for each in reviews_of(context.store, match, latest)
            if unit in each.request.keys and each.is_current
        ],
        "cameras": [camera.id for camera in match.folder.spec.static_cameras],
        "clip": next((clip.id for clip in match.folder.spec.clips_of(owner)), None),
        "key_frames": key_frames(match, owner),
    }


def _describe_pose(given: CameraCalibration) -> list[str]:
    """Return where a given camera stands, where it looks, and its lens, a sentence each."""
    camera = Camera.from_calibration(given)
    x, y, z = camera.center.tolist()
    along = np.asarray(given.rotation)[2]
    tilt = float(np.degrees(np.arcsin(np.clip(along[2], -1.0, 1.0))))
    turn = float(np.degrees(np.arctan2(along[1], along[0])))
    focal, middle = given.focal_px, given.principal_point_px
    bends = ", ".join(f"{value:.4g}" for value in given.distortion)
    return [
        f"It stands at x {x:.2f} m, y {y:.2f} m, z {z:.2f} m.",
        f"It looks {abs(tilt):.0f}° {'down' if tilt < 0 else 'up'}, to {turn:.0f}° from the x axis "
        "(y is at 90°).",
        f"Focal length {focal[0]:.1f} and {focal[1]:.1f} px, principal point ({middle[0]:.1f}, "
        f"{middle[1]:.1f}) px, lens model {given.lens_model} with distortion {bends}.",
    ]


def _propose(
    match: Match, drawing: PitchDrawing, owner: str, image: Image, wanted: Wanted
) -> dict[str, Any]:
    """Propose the camera from its image alone; a few seconds."""
    where = f"image of {owner}"
    try:
        found = propose_camera(
            image,
            drawing.template,
            side=wanted.side,
            lens=match.folder.lenses.get(owner),
            where=where,
        )
    except InputError as error:
        return {"drawn": {}, "markings": {}, "reason": describe_error(error)}
    answer = {
        "drawn": {each.name: each.xy for each in found.drawn.drawn},
        "markings": _round_pieces(drawing.project_markings(found.camera)),
        "reason": "",
    }
    try:
        found.require_clear(where, drawing.template)
    except InputError as error:
        answer["reason"] = describe_error(error)
    return answer


def warm_up(context: PageContext) -> None:
    """Calibrate one clicked camera, which loads kernels, and open the matches that changed last.

    The first request then waits for neither kernels nor journals.
    """
    is_warm, names = False, context.store.matches()
    changes = context.store.blobs.marks([f"reviews/{name}" for name in names])
    for _, name in sorted(zip(changes, names, strict=True))[-MOST_KEPT:]:
        try:
            folder = context.match(name).folder
            if folder.pitch is None or not folder.clicked or is_warm:
                continue
            camera, clicked = next(iter(folder.clicked.items()))
            spec = folder.spec.camera(camera)
            drawing = PitchDrawing(PitchTemplate.from_spec(folder.pitch))
            is_warm = True
            preview(drawing, clicked, (spec.width, spec.height), settings=_POINTS_ALONE)
        except (OSError, WorldposeError):
            continue  # the queue shows its error
    gc.collect()
    gc.freeze()  # collecting long journals as garbage would delay requests


def _find_picture(match: Match, owner: str, frame: int | None) -> Path:
    """Return the still or the video that has an image; 404 without one, or if it is gone."""
    stills, videos = match.folder.stills, match.folder.videos
    kind, files = ("still", stills) if frame is None and owner in stills else ("video", videos)
    file = files.get(owner)
    if file is None or not file.exists():
        said = "there is no picture" if file is None else f"the {kind} is not at hand"
        raise HTTPException(404, said)
    return file


def _read(match: Match, owner: str, frame: int | None, file: Path) -> NDArray[np.uint8]:
    spec = match.folder.spec
    if file == match.folder.stills.get(owner):
        camera = spec.camera(owner)
        return read_still(file, (camera.width, camera.height))
    with open_video(file) as video:
        number = 0
        if frame is not None:
            fps = spec.fps * unit_frames(spec, owner).rate
            number = int(video.index.shown(np.array([frame]), fps, owner)[0])
        if not 0 <= number < len(video):
            raise HTTPException(404, "the video has no such frame")
        return video.frame(number)


def _read_clicks(match: Match, owner: str, frame: int | None) -> ClickedMarkings:
    if frame is None:
        return match.folder.clicked.get(owner, ClickedMarkings())
    picked = match.folder.key_frames.get(owner)
    frames = {} if picked is None else {each.frame: each.markings for each in picked.key_frames}
    return frames.get(frame, ClickedMarkings())


def key_frames(match: Match, owner: str) -> list[int]:
    """Return the frames of a clip's video that a person clicked."""
    picked = match.folder.key_frames.get(owner)
    return [] if picked is None else [each.frame for each in picked.key_frames]


def _pitch(drawing: PitchDrawing) -> dict[str, Any]:
    """Return the template for the small map: names, positions and shapes [m]."""
    template = drawing.template
    return {
        "length": template.length,
        "width": template.width,
        "points": {name: _round_numbers(place, 3) for name, place in template.points.items()},
        "markings": {name: _round_numbers(line, 2) for name, line in drawing.markings.items()},
    }


def _round_pieces(markings: Mapping[str, list[NDArray[np.float64]]]) -> dict[str, Any]:
    return {name: [_round_numbers(each, 1) for each in pieces] for name, pieces in markings.items()}


def _answer(found: Preview) -> dict[str, Any]:
    report, camera = found.report, found.camera
    ground = report.ground_error
    return {
        "camera": {
            "center": _round_numbers(camera.center, 3),
            "focal": round(float(camera.focal[0]), 1),
        },
        "markings": _round_pieces(found.markings),
        "points": {name: _round_numbers(place, 2) for name, place in found.points.items()},
        "residuals": [
            {
                "name": each.name,
                "residual": _round_numbers(each.residual, 3)
                if np.isfinite(each.residual).all()
                else None,
                "surprise": _number(each.mahalanobis),
                "inlier": each.inlier,
                "problem": each.problem,
            }
            for each in report.points
        ],
        "drawn": [
            {
                "name": each.name,
                "rms": _number(each.rms),
                "worst": _number(each.worst),
                "inlier": each.inlier,
            }
            for each in report.drawn
        ],
        "wrong": report.wrong,
        "weak": report.weak,
        "reasons": report.reasons,
        "decisions": report.decisions,
        "add_next": report.add_next,
        "stage": report.stage,
        "median": _number(ground.median),
        "p95": _number(ground.p95),
        "limit": GROUND_LIMIT_M,
        "ground": {
            "x": _round_numbers(ground.x, 2),
            "y": _round_numbers(ground.y, 2),
            "expected": [[_number(value) for value in row] for row in ground.expected],
        },
    }


def _round_numbers(values: NDArray[np.float64], digits: int) -> Any:  # noqa: ANN401 - nested lists
    return np.round(values, digits).tolist()


def _number(value: float) -> float | None:
    """Round to four digits; None for NaN and infinity, which JSON lacks."""
    return float(f"{value:.4g}") if np.isfinite(value) else None
