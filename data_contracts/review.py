"""Review gates as data: requests, decisions and corrections (design: gates are records first)."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, JsonValue

from data_contracts.records import CONTRACT_VERSION, Key, Name, Record


class ReviewRequest(Record):
    """What a person is asked to look at, and the figures that asked for it."""

    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    match_id: Name
    run_id: Name
    gate: Name
    """The stage whose result waits."""
    keys: dict[str, Key]
    """Results under review: `stage/unit` to key."""
    figures: dict[str, float]
    """The figures that were outside their thresholds, with the unit in the name."""
    pictures: tuple[str, ...] = ()
    """Paths in the store."""
    created_at: datetime


class ReviewDecision(Record):
    """A person's verdict. It has no default: an empty answer never approves."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    request: Name
    """Id of the `ReviewRequest`."""
    verdict: Literal["approve", "reject"]
    who: str = Field(min_length=1)
    """Name or login of the person."""
    why: str = ""
    """In the person's words."""
    decided_at: datetime


class MovedPoint(Record):
    """A clicked pitch point put elsewhere in a camera's picture."""

    kind: Literal["moved_point"] = "moved_point"
    camera: Name
    marking: Name
    """Name of the point in the pitch template."""
    frame: int | None = None
    """Match frame of a moving camera's picture; None for a static camera."""
    xy: tuple[float, float]
    """[px]"""


class DeletedDetection(Record):
    """A detection that is no person of the match."""

    kind: Literal["deleted_detection"] = "deleted_detection"
    camera: Name
    frame: int
    """Match frame."""
    detection: int
    """Its place among the camera's detections of the frame."""


class AddedDetection(Record):
    """A person that the detector missed."""

    kind: Literal["added_detection"] = "added_detection"
    camera: Name
    frame: int
    """Match frame."""
    box: tuple[float, float, float, float]
    """x0, y0, x1, y1 [px]."""


class ChosenFrames(Record):
    """The frames that a stage is to use, instead of those it proposed (B1)."""

    kind: Literal["chosen_frames"] = "chosen_frames"
    stage: Name
    clip: Name
    frames: tuple[int, ...]
    """Match frames."""


class MovedKeypoint(Record):
    """A keypoint put elsewhere; `xy` None says that it cannot be seen."""

    kind: Literal["moved_keypoint"] = "moved_keypoint"
    camera: Name
    frame: int
    """Match frame."""
    detection: int
    """Its place among the camera's detections of the frame."""
    joint: Name
    xy: tuple[float, float] | None
    """[px]"""


class MergedTracks(Record):
    """Two person ids of a clip that are one person."""

    kind: Literal["merged_tracks"] = "merged_tracks"
    clip: Name
    kept: int
    merged: int


class SplitTrack(Record):
    """One person id of a clip that is two people from a frame on."""

    kind: Literal["split_track"] = "split_track"
    clip: Name
    person: int
    first_frame_of_new: int


Edit = Annotated[
    MovedPoint
    | DeletedDetection
    | AddedDetection
    | MovedKeypoint
    | MergedTracks
    | SplitTrack
    | ChosenFrames,
    Field(discriminator="kind"),
]


class Correction(Record):
    """One edit, replayed over untouched automatic output; never applied in place."""

    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    match_id: Name
    edit: Edit
    who: str = Field(min_length=1)
    made_at: datetime
    based_on: dict[str, Key]
    """The results the person looked at: `stage/unit` to key."""
    note: JsonValue = None
