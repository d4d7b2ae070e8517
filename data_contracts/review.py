"""Review gates as data: requests, decisions and corrections (design: gates are records first)."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, JsonValue

from data_contracts.records import (
    CONTRACT_VERSION,
    DetectionIndex,
    Digest,
    Frame,
    Key,
    Name,
    PersonId,
    PixelCoordinate,
    Record,
)
from data_contracts.static_calibration import Pixel

Origin = Literal["automatic", "corrected", "filled", "rejected"]
"""Where a value comes from: computed from what was seen, from what a person corrected, from motion
alone, or computed and refused by a person."""


class ReviewRequest(Record):
    """What a person is asked to look at, and why."""

    kind: Literal["request"] = "request"
    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    match_id: Name
    run_id: Name
    gate: Name
    """The stage whose result waits."""
    keys: dict[str, Key]
    """Results under review: `stage/unit` to key."""
    contents: dict[str, Digest]
    """The same results' contents: a verdict holds for the bytes, whatever key gives them again."""
    reasons: tuple[str, ...]
    """One line each: figures beyond their limits, or that every result is asked about."""
    figures: dict[str, float]
    """All figures of the results, with the unit in the name."""
    pictures: tuple[str, ...] = ()
    """Paths in the store."""
    created_at: datetime


class ReviewDecision(Record):
    """A person's verdict. It has no default: an empty answer never approves."""

    kind: Literal["decision"] = "decision"
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
    """A clicked pitch point put elsewhere in a camera's picture, added or removed."""

    kind: Literal["moved_point"] = "moved_point"
    camera: Name
    """A static camera, or the clip of a moving one."""
    marking: Name
    """Name of the point in the pitch template."""
    frame: Frame | None = None
    """Frame of the clip's video; None for a static camera."""
    was: Pixel | None = None
    """Where it was when the person moved it [px]; None where it was not clicked."""
    xy: Pixel | None
    """[px]; None removes it."""


class RedrawnMarking(Record):
    """A line or arc drawn anew in a camera's picture, added or removed."""

    kind: Literal["redrawn_marking"] = "redrawn_marking"
    camera: Name
    """A static camera, or the clip of a moving one."""
    marking: Name
    """Name of the line or arc in the pitch template."""
    frame: Frame | None = None
    """Frame of the clip's video; None for a static camera."""
    was: tuple[Pixel, ...] = ()
    """How it was drawn when the person drew it anew [px]; empty where it was not."""
    xy: tuple[Pixel, ...]
    """[px]; empty removes it."""


class DeletedDetection(Record):
    """A detection that is no person of the match."""

    kind: Literal["deleted_detection"] = "deleted_detection"
    camera: Name
    frame: Frame
    """Match frame."""
    detection: DetectionIndex
    """Its place among the camera's detections of the frame."""


class AddedDetection(Record):
    """A person that the detector missed."""

    kind: Literal["added_detection"] = "added_detection"
    camera: Name
    frame: Frame
    """Match frame."""
    detection: DetectionIndex
    """The place that the person takes among the camera's detections of the frame: a free one."""
    box: tuple[PixelCoordinate, PixelCoordinate, PixelCoordinate, PixelCoordinate]
    """x0, y0, x1, y1 [px]."""
    keypoints: tuple[Pixel | None, ...] = Field(default=(None,) * 17, min_length=17, max_length=17)
    """[px], in the order of COCO-17; None where a joint cannot be seen."""


class ChosenFrames(Record):
    """The frames that a stage is to use, instead of those it proposed (B1)."""

    kind: Literal["chosen_frames"] = "chosen_frames"
    stage: Name
    clip: Name
    frames: tuple[Frame, ...]
    """Match frames."""


class MovedKeypoint(Record):
    """A keypoint put elsewhere; `xy` None says that it cannot be seen."""

    kind: Literal["moved_keypoint"] = "moved_keypoint"
    camera: Name
    frame: Frame
    """Match frame."""
    detection: DetectionIndex
    """Its place among the camera's detections of the frame."""
    joint: Name
    """Name in COCO-17."""
    was: Pixel | None = None
    """Where it was when the person moved it [px]; None where it was not seen."""
    xy: Pixel | None
    """[px]"""


class Sighting(Record):
    """One detection that tells who is meant, whatever ids the tracker gives."""

    camera: Name
    frame: Frame
    """Match frame."""
    detection: DetectionIndex
    """Its place among the camera's detections of the frame."""


class MergedTracks(Record):
    """Two person ids of a clip that are one person."""

    kind: Literal["merged_tracks"] = "merged_tracks"
    clip: Name
    kept: PersonId
    kept_seen: Sighting | None = None
    """Where the person saw who that is; no longer so, and the correction does not apply."""
    merged: PersonId
    merged_seen: Sighting | None = None
    """As `kept_seen`."""


class SplitTrack(Record):
    """One person id of a clip that is two people from a frame on."""

    kind: Literal["split_track"] = "split_track"
    clip: Name
    person: PersonId
    seen: Sighting | None = None
    """Where the person saw who that is; no longer so, and the correction does not apply."""
    first_frame_of_new: Frame
    """Match frame."""


class NamedTrack(Record):
    """The roster's name of a person id of a clip."""

    kind: Literal["named_track"] = "named_track"
    clip: Name
    person: PersonId
    seen: Sighting | None = None
    """Where the person saw who that is; no longer so, and the correction does not apply."""
    name: Name | None
    """Id in the roster; None takes it away."""


Edit = Annotated[
    MovedPoint
    | RedrawnMarking
    | DeletedDetection
    | AddedDetection
    | MovedKeypoint
    | MergedTracks
    | SplitTrack
    | NamedTrack
    | ChosenFrames,
    Field(discriminator="kind"),
]


class Correction(Record):
    """One edit, replayed over untouched automatic output; never applied in place."""

    kind: Literal["correction"] = "correction"
    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    match_id: Name
    edit: Edit
    who: str = Field(min_length=1)
    made_at: datetime
    based_on: dict[str, Key]
    """The results the person looked at: `stage/unit` to key."""
    note: JsonValue = None


class Withdrawal(Record):
    """A correction taken back."""

    kind: Literal["withdrawal"] = "withdrawal"
    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    correction: Name
    """Id of the `Correction`."""
    who: str = Field(min_length=1)
    why: str = ""
    withdrawn_at: datetime


class Acceptance(Record):
    """Detections that a person found right; it tells what is left to look at, and changes nothing.

    It holds for the results that it names: found anew with other bytes, they are to be looked at.
    """

    kind: Literal["acceptance"] = "acceptance"
    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    match_id: Name
    results: dict[str, Key]
    """Of one camera, as they are without corrections: `stage/unit` to key."""
    at_least: float | None = Field(default=None, ge=0, le=1)
    """Everybody whose score is at least this [1]; None = nobody but those named."""
    people: tuple[tuple[Frame, DetectionIndex], ...] = ()
    """Match frame, and place among the detections of the frame."""
    who: str = Field(min_length=1)
    accepted_at: datetime


ReviewRecord = Annotated[
    ReviewRequest | ReviewDecision | Correction | Withdrawal | Acceptance,
    Field(discriminator="kind"),
]


class JournalEntry(Record):
    """reviews/<match>/<number>.json: what was said at once; entries are added, never changed."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    number: int = Field(ge=1, le=1 << 53)
    """Its place in the journal."""
    previous: Digest | None
    """Checksum of the entry before it, None for the first: a lost or changed one is seen."""
    records: tuple[ReviewRecord, ...] = Field(min_length=1)
