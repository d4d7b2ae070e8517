"""Task of stage `proposal`: one camera before its calibration, and the people in its images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import CameraCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.proposal import PROPOSAL
from tasks.detection import footage_index, require_weights
from tasks.static_calibration import clicked_markings, given_lens, open_still, require_picture
from tasks.unit import UnitInputs, unit_task
from worldpose.detection.models import load_detectors
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera, camera_arrays
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.from_paint.proposal import propose_camera
from worldpose.static_calibration.settings import ProposalSettings, StaticCalibrationSettings
from worldpose.static_calibration.sides import place_at
from worldpose.store.writer import ResultWriter
from worldpose.tracking.plane.feet import locate_feet
from worldpose.video.folder import open_video


@unit_task
def proposal(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the camera, proposed from its image unless it is known, and people's places."""
    settings = inputs.settings(ProposalSettings)
    attributes: dict[str, Any] = {
        "camera_id": inputs.unit,
        "fps": inputs.sources["fps"],
        "is_stated": True,
        "is_clear": True,
        "problem": None,
        "drawn": {},
        "markings": [],
        **dict.fromkeys(("score", "margin", "found", "explained")),
    }
    pitch = inputs.pitch if "pitch" in inputs.sources else None
    try:
        camera, found = _find_camera(inputs, pitch, settings)
    except InputError as error:  # one camera must not end the match
        words = {name: getattr(error, name) for name in ("where", "expected", "found", "todo")}
        none = {"origin": "none", "is_clear": False, "problem": words}
        result.write(PROPOSAL, arrays={}, attributes={**attributes, **none})
        return
    arrays: dict[str, Any] = dict(camera_arrays(camera))
    frames = {}
    if inputs.sources["people"] is not None:
        people = _find_people(inputs, settings.people_frames)
        feet = locate_feet(Camera.stack([camera]), people, pitch or PitchTemplate.standard())
        arrays |= {"place": feet.xy[:, 0], "place_covariance": feet.noise[:, 0]}
        frames = {"frame": people.frame}
    result.write(PROPOSAL, arrays=arrays, coordinates=frames, attributes={**attributes, **found})
    if found["origin"] == "image":
        names = ("margin", "found", "explained")
        result.figures.update({name: float(found[name]) for name in names})


def _find_camera(
    inputs: UnitInputs, pitch: PitchTemplate | None, settings: ProposalSettings
) -> tuple[Camera, Mapping[str, Any]]:
    """Return the camera, and the stored attributes that tell how it was found, or InputError."""
    sources = inputs.sources
    if sources["calibration"] is not None:
        given = CameraCalibration.model_validate(sources["calibration"])
        return Camera.from_calibration(given), {"origin": "given"}
    assert pitch is not None  # registration requires it
    lens, side = given_lens(sources), sources["side"]
    if sources["clicked"]:
        ((file, clicked),) = sources["clicked"].items()
        calibration = calibrate_camera(
            pitch,
            clicked_markings(clicked),
            tuple(sources["image_size"]),
            settings=StaticCalibrationSettings(prior=settings.prior, lines=False),
            where=file,
            lens=lens,
            start=side and place_at(side),
        )
        return calibration.estimate.camera, {"origin": "points"}
    proposed = propose_camera(
        require_picture(inputs.unit, open_still(inputs)),
        pitch,
        side=side or "near",
        prior=settings.prior,
        lens=lens,
        where=f"image of {inputs.unit}",
    )
    return proposed.camera, {
        "origin": "image",
        "is_stated": side is not None,
        "is_clear": proposed.is_clear,
        **proposed.attributes(),
    }


def _find_people(inputs: UnitInputs, count: int) -> KeypointDetections:
    """Return the people (frames, 1 camera, people) of evenly spaced frames."""
    wanted = inputs.sources["people"]
    every = np.concatenate([np.arange(first, first + size) for first, size in wanted["ranges"]])
    frames = every[np.linspace(0, len(every) - 1, min(count, len(every))).astype(np.int64)]
    stored = inputs.open(f"ingest/{inputs.unit}")
    if wanted["video"] is None:
        given = KeypointDetections.from_arrays(stored.sel(frame=frames))
        return KeypointDetections.stack([given])
    settings = DetectionSettings()
    require_weights(settings, inputs.sources["weights"])
    (detector,) = load_detectors(settings)
    boxes: list[NDArray[np.float64]] = []
    numbers = stored["picture_of_frame"].sel(frame=frames).values
    with open_video(Path(inputs.work.folder) / wanted["video"], footage_index(stored)) as video:
        for number in numbers.tolist():
            shown = video.readable(number, number + 1) if number >= 0 else ()
            picture = next((each for _, each in shown), None)
            if picture is None:
                boxes.append(np.empty((0, 4)))
                continue
            (people,) = detector.detect([picture])
            boxes.append(people.boxes[people.scores >= settings.high_score_threshold])
    most = max(1, *(len(each) for each in boxes))
    placed = np.full((len(frames), 1, most, 4), np.nan)
    for row, each in enumerate(boxes):
        placed[row, 0, : len(each)] = each
    return KeypointDetections(
        keypoints=np.full((*placed.shape[:3], 17, 2), np.nan),
        confidence=np.full((*placed.shape[:3], 17), np.nan),
        boxes=placed,
        score=np.where(np.isnan(placed[..., 0]), np.nan, 1.0),
        frame=frames,
    )
