"""Tasks of stages `broadcast_calibration`, `broadcast_pooling` and `broadcast_tracking`.

The moving camera of one clip in every frame, its position pooled over clips, and the people on the
pitch by feet and shirts in a match without static cameras.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import Image
from data_contracts.broadcast_calibration import BROADCAST_CALIBRATION, BROADCAST_POOLING, KeyFrame
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.tracking import BROADCAST_TRACKING, Track
from tasks.clip_inputs import ADJUSTED, select_frames
from tasks.static_calibration import clicked_markings
from tasks.unit import UnitInputs, unit_task
from worldpose.broadcast_calibration.estimate import BroadcastClip, calibrate_broadcast
from worldpose.broadcast_calibration.given_camera import GivenCamera
from worldpose.broadcast_calibration.key_frames import KnownPeople, must_turn, propose_key_frames
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.pitch_errors import SIZES
from worldpose.broadcast_calibration.players import People, boxes_of
from worldpose.broadcast_calibration.report import (
    BroadcastReport,
    broadcast_arrays,
    broadcast_attributes,
)
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.uncertainty import (
    Uncertainty,
    drawn_to,
    moving_arrays,
    moving_from_arrays,
    pool_centers,
    static_covariance,
)
from worldpose.formats.camera_data import read_camera_data
from worldpose.formats.challenge import read_kit_array
from worldpose.ingest.clock import ImageClock, camera_frames
from worldpose.pitch.template import PitchTemplate
from worldpose.store.writer import ResultWriter
from worldpose.tracking.plane.feet import GroundPositions, locate_feet
from worldpose.tracking.plane.shirts import measure_shirts
from worldpose.tracking.plane.tracker import (
    GroundTracks,
    find_given_people,
    locate_tracks,
    track_on_plane,
)
from worldpose.video.folder import grey_on_clock, open_video, pictures_at

SIZE_METRICS: Final = {
    "length": ("length_m", "length_std_m"),
    "width": ("width_m", "width_std_m"),
    "crown": ("crown_m", "crown_std_m"),
    "end_fall": ("end_fall_m", "end_fall_std_m"),
}
"""Metrics of a size of the pitch, if it is estimated: its value and standard deviation [m]."""
PROPOSED_FRAMES: Final = 8
"""Frames of a clip without clicks to propose key frames in, evenly spaced [1]."""


@unit_task
def broadcast_calibration(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write a camera per frame, and its uncertainty.

    It is found for every image of the video, also if its frame rate is not that of the match.
    """
    sources, clock = inputs.sources, image_clock(inputs)
    start, fps = int(clock.images[0]), float(sources["fps"]) * clock.rate
    ((file, clicked),) = sources["key_frames"].items()

    def pictures() -> Iterator[Image]:
        return grey_on_clock(inputs.file("video"), clock.images, fps)

    seen, people, boxes = _people(inputs, clock)
    pitch = _open_pitch(inputs)
    key_frames = [
        KeyFrame(frame=int(frame), markings=clicked_markings(markings))
        for frame, markings in clicked.items()
        if int(frame) in clock.images
    ]
    if beyond := clicked.keys() - {str(key.frame) for key in key_frames}:
        result.warnings.append(
            f"{file}: key frames {', '.join(sorted(beyond, key=int))} are outside of the clip's "
            f"{start} to {clock.images[-1]} and are not used."
        )
    settings, given = inputs.settings(BroadcastCalibrationSettings), None
    is_proposed = not key_frames
    if "camera_data" in sources:
        known = _known_people(clock, people, seen)
        given, projected = _open_given(inputs, pitch, clock, known, is_alone=is_proposed)
    if "side" in sources:
        key_frames = _propose(inputs, pitch, clock, people, seen)
    elif given is not None and is_proposed:
        file, key_frames = sources["camera_data"], projected
        given = replace(given, leads=True)
    calibration = calibrate_broadcast(
        pitch,
        BroadcastClip(
            key_frames,
            pictures,
            fps,
            people=people,
            boxes=boxes,
            where=file,
            first=start,
            proposed=is_proposed,
            smooth_weight=sources.get("smooth", 1.0),
            given=given,
        ),
        settings,
    )
    inputs.require_registered("video")
    layout = BROADCAST_CALIBRATION
    result.write(
        layout,
        arrays={
            name: values[clock.image_row] if "frame" in layout.layout(name).dims else values
            for name, values in broadcast_arrays(calibration).items()
        },
        coordinates={"frame": inputs.frames},
        attributes=broadcast_attributes(_clip_of(inputs), calibration, start, clock.rate),
    )
    result.figures.update(_figures(calibration.report))
    if reasons := calibration.report.reasons:
        result.warnings.append(
            f"the broadcast camera of {inputs.unit} needs a check: {'; '.join(reasons)}."
        )


def image_clock(inputs: UnitInputs, ends: str = "") -> ImageClock:
    """Return the images of a broadcast view, from sources whose names end with `ends`."""
    sources = inputs.sources
    return ImageClock.of(
        inputs.frames,
        sources[f"offset_frames{ends}"],
        sources.get(f"rate{ends}", 1.0),
        float(sources[f"broadcast_offset_frames{ends}"]),
    )


def _clip_of(inputs: UnitInputs) -> str:
    """Return the clip of a broadcast view: its name, or that of the fitted bodies."""
    stage = "body_fitting/"
    fitted = (name.removeprefix(stage) for name in inputs.recipe.inputs if name.startswith(stage))
    return next(fitted, inputs.unit)


def _propose(
    inputs: UnitInputs,
    pitch: PitchTemplate,
    clock: ImageClock,
    people: People | None,
    seen: KeypointDetections | None,
) -> list[KeyFrame]:
    """Return key frames that are proposed from images spread over the clip."""
    images = clock.images
    many = min(len(images), PROPOSED_FRAMES)
    numbers = np.unique(np.linspace(images[0], images[-1], many).astype(int))

    def spread_out() -> Iterator[tuple[int, Image]]:
        with open_video(inputs.file("video")) as video:
            fps = float(inputs.sources["fps"]) * clock.rate
            shown = video.index.shown(numbers, fps, str(inputs.file("video")))
            for number, at in zip(numbers.tolist(), shown.tolist(), strict=True):
                if at >= 0:
                    yield number, video.frame(at)

    known = _known_people(clock, people, seen)
    where, side = str(inputs.file("video")), inputs.sources["side"]
    return propose_key_frames(spread_out(), pitch, side=side, where=where, people=known)


def _open_given(
    inputs: UnitInputs,
    pitch: PitchTemplate,
    clock: ImageClock,
    people: KnownPeople | None,
    *,
    is_alone: bool,
) -> tuple[GivenCamera, list[KeyFrame]]:
    """Return the camera data of the clip's images, and key frames as they project them.

    Without key frames, data are alone and must have the side of the people.
    """
    with open_video(inputs.file("video")) as video:
        size = video.index.size
    rate = float(inputs.sources["fps"]) * clock.rate
    data = read_camera_data(inputs.file("camera_data"), rate, size)
    inputs.require_registered("camera_data")
    given, first = GivenCamera.of(data, clock.images), int(clock.images[0])
    prior = inputs.settings(BroadcastCalibrationSettings).prior
    found = given.propose_key_frames(pitch, size, prior)
    whole = given.camera(size, prior).camera
    cameras = {first + each.frame: whole[each.frame] for each in found}
    if cameras and is_alone:
        must_turn(cameras, pitch, "near", people, inputs.sources["camera_data"])
    moved = [each.model_copy(update={"frame": first + each.frame}) for each in found]
    return given, moved


def _known_people(
    clock: ImageClock, people: People | None, seen: KeypointDetections | None
) -> KnownPeople | None:
    """Return the people in a clip's images, and where the static cameras see them, if any do."""
    if people is None or seen is None:
        return None
    feet = np.mean(people.joints[:, :, 15:17, :2], axis=2)
    return KnownPeople(seen[clock.frame_of(clock.images)], feet, people.fps, int(clock.images[0]))


def _open_pitch(inputs: UnitInputs) -> PitchTemplate:
    """Return the pitch, on the surface that static cameras show, if any."""
    pitch = inputs.pitch
    assert pitch is not None  # else the clip is not calibrated
    surface = inputs.open(ADJUSTED).attrs["surface"] if ADJUSTED in inputs else None
    return pitch if surface is None else pitch.with_surface(surface)


def _people(
    inputs: UnitInputs, clock: ImageClock
) -> tuple[KeypointDetections | None, People | None, NDArray[np.float64] | None]:
    """Return detections, people fitted to static cameras in each image, and boxes in each image."""
    stored = _open_seen(inputs)
    if stored is None:
        return None, None, None
    seen, shown = KeypointDetections.from_arrays(stored), clock.frame_of(clock.images)
    fitted = f"body_fitting/{_clip_of(inputs)}"
    if fitted not in inputs:
        return seen, None, seen.boxes.astype(np.float64)[shown]
    keypoints, joints = seen.keypoints.astype(np.float64), inputs.open(fitted)["joints"].values
    people = People.in_images(joints, keypoints, float(inputs.sources["fps"]), clock)
    return seen, people, boxes_of(keypoints)[shown]


def _open_seen(inputs: UnitInputs) -> xr.Dataset | None:
    """Return the broadcast camera's detections in the clip, given or computed, if any."""
    for name in (f"ingest/{inputs.unit}", f"detection/{inputs.unit}"):
        if name in inputs:
            return select_frames(inputs.open(name), inputs.frames)
    return None


def _figures(report: BroadcastReport) -> dict[str, float]:
    """Return metrics of a calibrated clip; those that could not be computed are left out."""
    named = {
        "expected_error_median_px": report.reprojection_error,
        "marking_rms_median_px": report.marking_rms,
        "player_rms_median_px": report.player_rms,
    }
    figures = {
        name: float(np.nanmedian(values))
        for name, values in named.items()
        if np.isfinite(values).any()
    }
    offset = report.feed_offset
    if offset is not None and offset.determined:
        figures["feed_offset_frames"] = offset.frames
    for name, value, std in zip(SIZES, report.pitch.size, report.pitch.size_std, strict=True):
        if std > 0.0:
            figures |= dict(zip(SIZE_METRICS[name], (float(value), float(std)), strict=True))
    return figures | {"weak": float(bool(report.reasons))}


@unit_task
def broadcast_pooling(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the clip's camera at the pooled position, unchanged if the clips disagree."""
    clips: list[str] = inputs.sources["clips"]
    results = {clip: inputs.open(f"broadcast_calibration/{clip}") for clip in clips}
    places = [
        (each["center"].values, each["clip_covariance"].values[:3, :3]) for each in results.values()
    ]
    everybody = pool_centers(*zip(*places, strict=True))
    own = results[inputs.unit]
    camera, uncertainty = moving_from_arrays(own.data_vars)
    if everybody.agree:
        camera, uncertainty = drawn_to(camera, uncertainty, everybody)
    result.write(
        BROADCAST_POOLING,
        arrays=moving_arrays(camera, uncertainty),
        coordinates={"frame": own["frame"].values},
        attributes={
            "clip_id": own.attrs["clip_id"],
            "clips": clips,
            "distance": [float(distance) for distance in everybody.distance],
            "agree": everybody.agree,
        },
    )
    result.figures["agree"] = float(everybody.agree)


@unit_task
def broadcast_tracking(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the tracks of the clip's people and their places on the pitch."""
    sources, filmed = inputs.sources, open_broadcast(inputs)
    number = camera_frames(inputs.frames, sources["offset_frames"], sources["rate"])
    with open_video(inputs.file("video")) as video:
        fps = float(sources["fps"])
        number = video.index.shown(number, fps * sources["rate"], str(inputs.file("video")))
        positions = _locate_people(filmed, pictures_at(video, number))
    inputs.require_registered("video")
    size = filmed.pitch.length, filmed.pitch.width
    given_people = {}
    if "boxes" in sources:
        given = read_kit_array(inputs.file("boxes"), "boxes")[number]
        given[number < 0] = np.nan
        inputs.require_registered("boxes")
        found = find_given_people(given, filmed.detections.boxes)
        found[~np.isfinite(np.take_along_axis(positions.xy[:, 0, :, 0], found, axis=1))] = -1
        given_people["given_people"] = found.shape[1]
        person = np.flatnonzero((found >= 0).any(axis=0))
        tracks = locate_tracks(positions, found[:, None, person], fps)
    else:
        tracks = track_on_plane(positions, fps, pitch_size=size)
        person = np.arange(tracks.xy.shape[1])
    index = tracks.detection_index[:, 0]
    result.write(
        BROADCAST_TRACKING,
        arrays={
            "detection_index": index,
            "ground": tracks.xy.astype(np.float32),
            "ground_velocity": tracks.velocity.astype(np.float32),
            "ground_covariance": tracks.covariance.astype(np.float32),
            "ground_height": tracks.height.astype(np.float32),
        },
        coordinates={"frame": inputs.frames, "person": person.astype(np.int32)},
        attributes={
            "clip_id": inputs.unit,
            **given_people,
            "tracks": [
                _track(int(each), seen, sources["first_frame"])
                for each, seen in zip(person, index.T, strict=True)
            ],
        },
    )
    _report_tracks(inputs, result, tracks, int(np.isfinite(positions.xy[..., 0]).sum()))


def _report_tracks(
    inputs: UnitInputs, result: ResultWriter, tracks: GroundTracks, found: int
) -> None:
    """Write the metrics and warnings of tracks, made from this number of located detections."""
    index, name = tracks.detection_index[:, 0], inputs.recipe.name
    result.figures["people"] = float(index.shape[1])
    if found:
        result.figures["unmatched_share"] = 1.0 - np.count_nonzero(index >= 0) / found
    if not index.shape[1]:
        result.warnings.append(
            f"{name} found no person on the pitch: {found} detections have feet there. Check the "
            "camera in the report, and the detections."
        )
        return
    variance = np.trace(tracks.covariance, axis1=-2, axis2=-1)
    result.figures["plane_std_m"] = float(np.sqrt(np.nanmedian(variance)))
    if not inputs.sources["has_estimates"]:
        result.warnings.append(
            f"{name}: people have places on the pitch and no bodies. To get bodies from one "
            f"camera, save a monocular method's poses as estimates/{inputs.unit}.npz in the match "
            "folder, and run again."
        )


@dataclass(frozen=True, eq=False)
class BroadcastInputs:
    """The broadcast camera of a clip, and what it sees.

    Attributes:
        detections: stored detections of the clip's frames.
        camera: the moving camera, at the pooled position if there is one, and its covariance.
        pitch: surface under the feet, as the calibration found it.
    """

    detections: KeypointDetections
    camera: tuple[MovingCamera, Uncertainty]
    pitch: PitchTemplate


def open_broadcast(inputs: UnitInputs) -> BroadcastInputs:
    """Read the broadcast camera and its detections in the unit's clip."""
    name = f"broadcast_calibration/{inputs.unit}"
    calibrated = inputs.open(name)
    moving = inputs.open_first(f"broadcast_pooling/{inputs.unit}", name)
    # The surface that the calibration found: people stand on it as the markings lie on it.
    surface = {name: (calibrated.attrs["pitch"] or {}).get(name) for name in SIZES}
    known = {name: value for name, value in surface.items() if value is not None}
    pitch = PitchTemplate.from_spec(PitchSpec.model_validate(inputs.sources["pitch"] | known))
    detections = _open_seen(inputs)
    assert detections is not None  # else the clip has no unit
    seen = KeypointDetections.from_arrays(detections)
    return BroadcastInputs(seen, moving_from_arrays(moving.data_vars), pitch)


def _locate_people(filmed: BroadcastInputs, images: Iterator[Image | None]) -> GroundPositions:
    """Return places and shirts of a moving camera's detections, as those of one camera."""
    (moving, uncertainty), seen = filmed.camera, filmed.detections
    covariance, cameras = static_covariance(moving, uncertainty), moving.camera
    parts = []
    for frame, image in zip(range(len(moving)), images, strict=True):
        now = slice(frame, frame + 1)
        people = KeypointDetections.stack([seen[now]])
        found = locate_feet(cameras[now], people, filmed.pitch, camera_covariance=covariance[now])
        shirts = np.full((seen.boxes.shape[1], 3), np.nan)
        if image is not None:
            shirts = measure_shirts(
                image, seen.keypoints[frame], seen.confidence[frame], seen.boxes[frame]
            )
        # Parts start tracks, too: in a duel one player is often a part of the other's box.
        parts.append(replace(found, is_whole=None, boxes=None, shirts=shirts[None, None]))
    return GroundPositions.concatenate(parts)


def _track(person: int, index: NDArray[np.int16], first: int) -> dict[str, Any]:
    seen = np.flatnonzero(index >= 0)
    return Track(
        person=person,
        first_frame=first + int(seen[0]),
        last_frame=first + int(seen[-1]),
        frames_seen=len(seen),
        views=1.0,
        kind="plane",
    ).model_dump(mode="json")
