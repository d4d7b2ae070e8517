"""Replay of corrections over the clicks of a match folder."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from data_contracts.conventions import COCO17
from data_contracts.match import CameraSpec
from data_contracts.review import (
    AddedDetection,
    Correction,
    Edit,
    MovedKeypoint,
    MovedPoint,
    RedrawnMarking,
)
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking, Pixel
from worldpose.ingest.match_folder import MatchFolder
from worldpose.pitch.template import PitchTemplate
from worldpose.review.detections import DETECTION_EDITS, DetectionEdit
from worldpose.review.identities import IDENTITY_EDITS

Picture = tuple[str, int | None]
"""A static camera and None, or a clip and a frame of its video."""


@dataclass(frozen=True)
class Replay:
    """A match folder with corrections applied in order, and the `stale` ones, with reasons."""

    folder: MatchFolder
    applied: tuple[Correction, ...] = ()
    stale: tuple[tuple[Correction, str], ...] = ()


def replay_corrections(folder: MatchFolder, corrections: Iterable[Correction]) -> Replay:
    """Return the match folder with corrections applied in order, and the stale corrections.

    A correction applies only if the current value equals its `was`: the function does not move a
    point that has a new click in the match folder or another correction in between.
    """
    pictures = _pictures(folder)
    template = None if folder.pitch is None else PitchTemplate.from_spec(folder.pitch)
    applied, stale = [], []
    for correction in corrections:
        edit = correction.edit
        if isinstance(edit, IDENTITY_EDITS):
            # The stage `tracking`, which has the tracks, checks whether the edit applies.
            is_known = edit.clip in {clip.id for clip in folder.spec.clips}
            reason = None if is_known else f"there is no clip {edit.clip}"
        elif isinstance(edit, DETECTION_EDITS):
            # The camera's stage, which has the detections, checks whether the edit applies.
            reason = _unknown(folder, edit)
        elif isinstance(edit, MovedPoint | RedrawnMarking):
            reason = _objection(folder, template, pictures, edit)
        else:
            reason = f"no stage applies a correction of kind {edit.kind}"
        if reason is not None:
            stale.append((correction, reason))
            continue
        applied.append(correction)
        if isinstance(edit, MovedPoint | RedrawnMarking):
            picture = (edit.camera, edit.frame)
            pictures[picture] = _apply_edit(pictures.get(picture, ClickedMarkings()), edit)
    if any(isinstance(each.edit, MovedPoint | RedrawnMarking) for each in applied):
        cameras = (camera.id for camera in folder.spec.static_cameras)
        clicked = {name: pictures[name, None] for name in cameras if (name, None) in pictures}
        folder = replace(folder, clicked=clicked, key_frames=_key_frames(pictures))
    return Replay(folder, tuple(applied), tuple(stale))


def add_previous_value(folder: MatchFolder, edit: Edit) -> Edit:
    """Return the edit with the value in the match folder as `was`, unless it has one."""
    if not isinstance(edit, MovedPoint | RedrawnMarking) or "was" in edit.model_fields_set:
        return edit
    return edit.model_copy(update={"was": current_value(folder, edit)})


def current_value(
    folder: MatchFolder, edit: MovedPoint | RedrawnMarking
) -> Pixel | tuple[Pixel, ...] | None:
    """Return the value in the folder of an edit's point or marking: None or empty without one."""
    return _now(_pictures(folder), edit)


def _pictures(folder: MatchFolder) -> dict[Picture, ClickedMarkings]:
    pictures: dict[Picture, ClickedMarkings] = {
        (camera, None): clicked for camera, clicked in folder.clicked.items()
    }
    for clip, picked in folder.key_frames.items():
        pictures |= {(clip, each.frame): each.markings for each in picked.key_frames}
    return pictures


def _objection(
    folder: MatchFolder,
    template: PitchTemplate | None,
    pictures: dict[Picture, ClickedMarkings],
    edit: MovedPoint | RedrawnMarking,
) -> str | None:
    """Return why an edit does not apply; None if it does."""
    place = edit.camera if edit.frame is None else f"{edit.camera} frame {edit.frame}"
    if template is None:
        return "the match has no pitch"
    camera = folder.spec.filming_camera(edit.camera)
    is_static = edit.camera in {each.id for each in folder.spec.static_cameras}
    if camera is None or is_static != (edit.frame is None):
        return f"there is no image {place}"
    if edit.frame is None and edit.camera in folder.calibrations:
        return f"camera {edit.camera} is given, so that its clicks decide nothing"
    is_point = isinstance(edit, MovedPoint)
    if edit.marking not in (template.points if is_point else template.marking_names):
        return f"the pitch has no {'point' if is_point else 'marking'} {edit.marking}"
    for pixel in _pixels(edit.xy):
        if not _is_inside(pixel, camera):
            return f"{list(pixel)} is outside of the image {place}"
    now = _now(pictures, edit)
    if now != edit.was:
        was, found = (", ".join(map(str, _pixels(it))) or "not there" for it in (edit.was, now))
        return f"{edit.marking} in {place} was {was} when it was corrected, and is {found} now"
    return None


def _unknown(folder: MatchFolder, edit: DetectionEdit) -> str | None:
    """Return why a correction of detections is invalid in the match; None if it is valid."""
    camera = folder.spec.filming_camera(edit.camera)
    if camera is None:
        return f"there is no camera {edit.camera}"
    placed: tuple[Pixel | None, ...] = ()
    if isinstance(edit, MovedKeypoint):
        if edit.joint not in COCO17:
            return f"COCO-17 has no joint {edit.joint}"
        placed = (edit.xy,)
    elif isinstance(edit, AddedDetection):
        x0, y0, x1, y1 = edit.box
        is_inside = x0 < camera.width and y0 < camera.height and x1 > 0 and y1 > 0
        if not (x0 < x1 and y0 < y1 and is_inside):
            return f"{list(edit.box)} is not a box inside the image of {edit.camera}"
        placed = edit.keypoints
    for xy in placed:
        if xy is not None and not _is_inside(xy, camera):
            return f"{list(xy)} is outside of the image of {edit.camera}"
    return None


def _is_inside(pixel: Pixel, camera: CameraSpec) -> bool:
    x, y = pixel
    return -0.5 <= x <= camera.width - 0.5 and -0.5 <= y <= camera.height - 0.5


def _pixels(xy: Pixel | tuple[Pixel, ...] | None) -> tuple[Pixel, ...]:
    """Return the pixel of a point, or those of a marking, as a tuple of pixels."""
    if not xy:
        return ()
    return (xy,) if isinstance(xy[0], float | int) else xy


def _now(
    pictures: dict[Picture, ClickedMarkings], edit: MovedPoint | RedrawnMarking
) -> Pixel | tuple[Pixel, ...] | None:
    """Return the current value of an edit's point or marking."""
    clicked = pictures.get((edit.camera, edit.frame), ClickedMarkings())
    if isinstance(edit, MovedPoint):
        return {point.name: point.xy for point in clicked.points}.get(edit.marking)
    return {marking.name: marking.xy for marking in clicked.drawn}.get(edit.marking, ())


def _apply_edit(clicked: ClickedMarkings, edit: MovedPoint | RedrawnMarking) -> ClickedMarkings:
    if isinstance(edit, MovedPoint):
        points = {point.name: point for point in clicked.points}
        points.pop(edit.marking, None)
        if edit.xy is not None:
            points[edit.marking] = ClickedPoint(name=edit.marking, xy=edit.xy)
        return clicked.model_copy(update={"points": tuple(points.values())})
    drawn = {marking.name: marking for marking in clicked.drawn}
    drawn.pop(edit.marking, None)
    if edit.xy:
        drawn[edit.marking] = DrawnMarking(name=edit.marking, xy=edit.xy)
    return clicked.model_copy(update={"drawn": tuple(drawn.values())})


def _key_frames(pictures: dict[Picture, ClickedMarkings]) -> dict[str, KeyFrames]:
    """Return the key frames of the clips, without frames that have no clicks."""
    picked: dict[str, list[KeyFrame]] = {}
    for (clip, frame), markings in pictures.items():
        if frame is not None and (markings.points or markings.drawn):
            picked.setdefault(clip, []).append(KeyFrame(frame=frame, markings=markings))
    return {
        clip: KeyFrames(key_frames=tuple(sorted(frames, key=lambda each: each.frame)))
        for clip, frames in picked.items()
    }
