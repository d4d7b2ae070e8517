"""Review gates as data: requests, decisions and corrections."""

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
    Label,
    Name,
    PersonId,
    PixelCoordinate,
    Record,
    UnitName,
)
from data_contracts.static_calibration import Pixel

Origin = Literal["automatic", "corrected", "rejected"]
"""Origin of a result: computed from observations, computed from corrected observations, or computed
and rejected in a review."""


class ReviewRequest(Record):
    """A question to a reviewer: the results under review, and the reasons."""

    kind: Literal["request"] = "request"
    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    match_id: Name
    run_id: Name
    gate: Name
    """The stage whose result is under review."""
    keys: dict[str, Key]
    """Results under review: `stage/unit` to key."""
    contents: dict[str, Digest]
    """Digests of the same results' contents: a verdict is valid for equal bytes under any key."""
    reasons: tuple[str, ...]
    """One line each: metrics beyond their limits, or that every result is reviewed."""
    figures: dict[str, float]
    """All metrics of the results, with the unit in the name."""
    pictures: tuple[str, ...] = ()
    """Paths in the store."""
    created_at: datetime


class ReviewDecision(Record):
    """A reviewer's verdict. It has no default: an empty answer never approves."""

    kind: Literal["decision"] = "decision"
    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    request: Name
    """Id of the `ReviewRequest`."""
    verdict: Literal["approve", "reject"]
    who: str = Field(min_length=1)
    """Name or login of the reviewer."""
    why: str = ""
    """Reason, as written by the reviewer."""
    decided_at: datetime


class ClickedPlace(Record):
    """A point, line or arc of the pitch template in one image."""

    camera: UnitName
    """A static camera, or the clip of a moving one."""
    marking: Name
    """Its name in the pitch template."""
    frame: Frame | None = None
    """Frame of the clip's video; None for a static camera."""


class MovedPoint(ClickedPlace):
    """A clicked pitch point that is moved, added or removed."""

    kind: Literal["moved_point"] = "moved_point"
    was: Pixel | None = None
    """Former pixel [px]; None if it was not clicked."""
    xy: Pixel | None
    """[px]; None removes it."""


class RedrawnMarking(ClickedPlace):
    """A drawn line or arc that is replaced, added or removed."""

    kind: Literal["redrawn_marking"] = "redrawn_marking"
    was: tuple[Pixel, ...] = ()
    """Former pixels [px]; empty if it was not drawn."""
    xy: tuple[Pixel, ...]
    """[px]; empty removes it."""


class Sighting(Record):
    """One detection that identifies a person, independent of the tracker's ids."""

    camera: UnitName
    frame: Frame
    """Match frame."""
    detection: DetectionIndex
    """Its index among the camera's detections of the frame; a free one for an added detection."""


Box = tuple[PixelCoordinate, PixelCoordinate, PixelCoordinate, PixelCoordinate]
"""x0, y0, x1, y1 [px]."""


class DeletedDetection(Sighting):
    """A detection that is no person of the match."""

    kind: Literal["deleted_detection"] = "deleted_detection"
    was: Box | None = None
    """Its box [px]; None in entries without it, which delete whatever has the index."""


class AddedDetection(Sighting):
    """A person that the detector missed."""

    kind: Literal["added_detection"] = "added_detection"
    box: Box
    """x0, y0, x1, y1 [px]."""
    keypoints: tuple[Pixel | None, ...] = Field(default=(None,) * 17, min_length=17, max_length=17)
    """[px], in the order of COCO-17; None for an invisible joint."""


class ChosenFrames(Record):
    """Frames that a stage uses instead of its own choice."""

    kind: Literal["chosen_frames"] = "chosen_frames"
    stage: Name
    clip: Name
    frames: tuple[Frame, ...]
    """Match frames."""


class MovedKeypoint(Sighting):
    """A keypoint that is moved; `xy` None marks it as invisible."""

    kind: Literal["moved_keypoint"] = "moved_keypoint"
    joint: Name
    """Name in COCO-17."""
    was: Pixel | None = None
    """Former pixel [px]; None if it was not detected."""
    xy: Pixel | None
    """[px]"""


class MergedTracks(Record):
    """Two person ids of a clip that are one person."""

    kind: Literal["merged_tracks"] = "merged_tracks"
    clip: Name
    kept: PersonId
    kept_seen: Sighting | None = None
    """Detection of the person at the time of the correction; if it now belongs to another person,
    the correction does not apply."""
    merged: PersonId
    merged_seen: Sighting | None = None
    """The same detection for the person `merged`."""


class SplitTrack(Record):
    """One person id of a clip that is another person from some frame on."""

    kind: Literal["split_track"] = "split_track"
    clip: Name
    person: PersonId
    seen: Sighting | None = None
    """Detection of the person at the time of the correction; if it now belongs to another person,
    the correction does not apply."""
    first_frame_of_new: Frame
    """Match frame."""


class NamedTrack(Record):
    """The name of a track, which no result depends on."""

    kind: Literal["named_track"] = "named_track"
    clip: Name
    person: PersonId
    seen: Sighting | None = None
    """Detection of the person at the time of the correction; if it now belongs to another person,
    the correction does not apply."""
    name: Label | None
    """Id in the roster, or any other name; None removes it."""


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
    """The reviewed results: `stage/unit` to key."""
    note: JsonValue = None


class Withdrawal(Record):
    """The withdrawal of a correction."""

    kind: Literal["withdrawal"] = "withdrawal"
    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    correction: Name
    """Id of the `Correction`."""
    who: str = Field(min_length=1)
    why: str = ""
    withdrawn_at: datetime


class Acceptance(Record):
    """Detections that a reviewer accepted; this shortens the review queue and changes no result.

    It is valid for the named results; if they are recomputed with other bytes, the review is open
    again.
    """

    kind: Literal["acceptance"] = "acceptance"
    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    match_id: Name
    results: dict[str, Key]
    """Results of one camera without corrections: `stage/unit` to key."""
    at_least: float | None = Field(default=None, ge=0, le=1)
    """Accept detections with at least this score [1]; None = only those in `people`."""
    people: tuple[tuple[Frame, DetectionIndex], ...] = ()
    """Match frame, and index among the detections of the frame."""
    who: str = Field(min_length=1)
    accepted_at: datetime


ReviewRecord = Annotated[
    ReviewRequest | ReviewDecision | Correction | Withdrawal | Acceptance,
    Field(discriminator="kind"),
]


class JournalEntry(Record):
    """reviews/<match>/<number>.json: records written together; entries are only appended."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    number: int = Field(ge=1, le=1 << 53)
    """Its number in the journal."""
    previous: Digest | None
    """Checksum of the previous entry, None for the first: it reveals lost or changed entries."""
    records: tuple[ReviewRecord, ...] = Field(min_length=1)
