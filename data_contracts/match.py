"""match.yaml and the registration of a match folder."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from data_contracts.records import (
    CONTRACT_VERSION,
    Count,
    Digest,
    Frame,
    FrameOffset,
    FramesPerSecond,
    ImageLength,
    Name,
    PersonId,
    Record,
)

TEAM_SIZE: Final = 11
"""Players of a team on the pitch (Laws of the Game, 3)."""


def _one_error(value: object, read: ValidatorFunctionWrapHandler) -> object:
    """Return the value as read; of its two forms, an error names both at once."""
    if isinstance(value, list):  # here also strict rules see Python's lists, of a JSON file
        value = tuple(tuple(pair) if isinstance(pair, list) else pair for pair in value)
    try:
        return read(value)
    except ValidationError as error:
        raise PydanticCustomError(
            "clock_offset", "Input should be a number, or pairs [match frame, number]"
        ) from error


ClockOffset = Annotated[
    FrameOffset | tuple[tuple[Frame, FrameOffset], ...], WrapValidator(_one_error)
]
"""A camera's frame minus the match frame; a number, or rising pairs of a match frame and a number,
with linear change between them."""

Side = Literal["near", "far", "left", "right"]
"""Side of the pitch, seen from the main camera, which is near."""


class CameraSpec(Record):
    """One camera of the match folder."""

    id: Name
    kind: Literal["static", "broadcast"] = "static"
    width: ImageLength
    """[px]"""
    height: ImageLength
    """[px]"""
    fps: FramesPerSecond | None = None
    """[1/s]; absent = the match's."""
    offset_frames: ClockOffset = 0.0
    """This camera's own frame number at match frame 0: camera frame = match frame + offset. Pairs
    [match frame, offset] describe a clock that runs fast, or frames that a recorder lost."""
    video: str | None = None
    """Video file or folder of images, relative to the match folder."""
    still: str | None = None
    """One image of a static camera without a video, relative to the match folder."""
    side: Side | None = None
    """Side of the pitch on which the camera stands. A camera without clicks is calibrated from its
    image. The pitch looks the same after half a turn: the side of one camera, and people whom
    cameras share, decide."""

    @model_validator(mode="after")
    def _readable_clock(self) -> Self:
        offset, todo = self.offset_frames, "a broadcast clip has broadcast_offset_frames"
        if not isinstance(offset, tuple):
            if self.kind == "broadcast" or offset == int(offset):
                return self
            todo = f"a static camera's must be whole, or in pairs as [[0, {offset:g}]]"
        elif self.kind == "static":
            frames = [frame for frame, _ in offset]
            if frames and all(a < b for a, b in pairwise(frames)):
                return self
            todo = "give pairs [match frame, offset] with rising match frames"
        raise ValueError(f"camera {self.id} has offset_frames {offset}; {todo}")


class ClipSpec(Record):
    """An interval of the match that is reconstructed as a whole."""

    id: Name
    first_frame: Frame = 0
    """First match frame."""
    frame_count: int = Field(gt=0, le=200_000)
    """Tracks and joints of a clip are in memory as a whole: half of a match at 60 frames/s is
    170,000 frames."""
    broadcast: Name | None = None
    """The broadcast camera that filmed this clip, if any."""
    broadcast_offset_frames: FrameOffset = 0.0
    """Frame of the broadcast clip's own video at the clip's first frame."""
    people: dict[PersonId, Name] = {}
    """Person ids of the clip's tracks, with their ids in the roster, where known."""


class PlayerSpec(Record):
    """A person of the roster."""

    id: Name
    name: str = ""
    """Name to display."""
    team: str = ""
    """Name of the team; empty for officials."""
    role: Literal["player", "goalkeeper", "official"] = "player"


class MatchSpec(Record):
    """match.yaml."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    fps: FramesPerSecond
    """[1/s] of match time."""
    cameras: tuple[CameraSpec, ...] = Field(min_length=1)
    clips: tuple[ClipSpec, ...] = Field(min_length=1)
    pitch: str | None = None
    """`none` for footage without a pitch, a file name, or absent for the standard pitch."""
    roster: tuple[PlayerSpec, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ids = [camera.id for camera in self.cameras] + [clip.id for clip in self.clips]
        twice = sorted({name for name in ids if ids.count(name) > 1})
        if twice:
            raise ValueError(f"ids of cameras and clips must differ; used twice: {twice}")
        broadcast = {camera.id for camera in self.cameras if camera.kind == "broadcast"}
        for clip in self.clips:
            if clip.broadcast is not None and clip.broadcast not in broadcast:
                raise ValueError(
                    f"clip {clip.id} names broadcast camera {clip.broadcast!r}; "
                    f"broadcast cameras here: {sorted(broadcast)}"
                )
        roster = {player.id for player in self.roster}
        for clip in self.clips:
            named = list(clip.people.values())
            wrong = sorted({name for name in named if name not in roster or named.count(name) > 1})
            if wrong:
                raise ValueError(
                    f"clip {clip.id} names {wrong}, who are not in the roster or there twice"
                )
        for camera in self.cameras:
            if camera.kind == "broadcast" and camera.fps not in (None, self.fps):
                raise ValueError(
                    f"broadcast camera {camera.id} has fps {camera.fps:g}, the match "
                    f"{self.fps:g}; resample it first"
                )
        return self

    @property
    def static_cameras(self) -> tuple[CameraSpec, ...]:
        """The static cameras in file order, which is the order of every camera dimension."""
        return tuple(camera for camera in self.cameras if camera.kind == "static")

    @property
    def max_people(self) -> int | None:
        """The most people on the pitch at once, by the roster: two teams and the officials.

        None for a smaller roster, which may leave out people.
        """
        teams = Counter(person.team for person in self.roster if person.role != "official")
        officials = sum(person.role == "official" for person in self.roster)
        complete = len(teams) == 2 and min(teams.values()) >= TEAM_SIZE and officials > 0
        return 2 * TEAM_SIZE + officials if complete else None

    def camera(self, camera_id: str) -> CameraSpec:
        """The camera with this id.

        Raises:
            KeyError: no such camera.
        """
        return {camera.id: camera for camera in self.cameras}[camera_id]

    def filming_camera(self, owner: str) -> CameraSpec | None:
        """The static camera with this id, or the broadcast camera of the clip with this id."""
        broadcast = {clip.id: clip.broadcast for clip in self.clips}.get(owner)
        cameras = self.static_cameras if broadcast is None else self.cameras
        return {camera.id: camera for camera in cameras}.get(broadcast or owner)

    def clips_with(self, frame: int) -> tuple[ClipSpec, ...]:
        """The clips that contain a match frame."""
        return tuple(c for c in self.clips if 0 <= frame - c.first_frame < c.frame_count)

    def clip(self, clip_id: str) -> ClipSpec:
        """The clip with this id.

        Raises:
            KeyError: no such clip.
        """
        return {clip.id: clip for clip in self.clips}[clip_id]


class SourceFile(Record):
    """One file of a match folder as it was when the match was registered."""

    path: str
    """Relative to the match folder, with forward slashes."""
    size: Count
    """[byte]"""
    modified_ns: int = Field(ge=-(1 << 63), lt=1 << 63)
    """Only a hint that lets an unchanged file's digest be kept; never part of a key."""
    sha256: Digest


class Registration(Record):
    """A match that a project knows: its content and its folder."""

    contract: Literal[1] = CONTRACT_VERSION
    spec: MatchSpec
    folder: str
    """Absolute path of the match folder."""
    identity: Digest
    """Digest of videos, detections and pitch: the same content is the same match."""
    files: tuple[SourceFile, ...]

    def digest_of(self, path: str) -> str | None:
        """SHA-256 of a registered file, or of the names and contents of all files of a folder.

        None when the match folder has no such file or folder.
        """
        return self._digests.get(path)

    @cached_property
    def _digests(self) -> dict[str, str]:
        """All digests by path, cached: a video as single images has 180,000 files per hour."""
        listed: dict[str, Any] = {}
        for source in self.files:
            for end in (match.start() for match in re.finditer("/", source.path)):
                folder, name = source.path[:end], source.path[end + 1 :]
                content = listed.setdefault(folder, hashlib.sha256())
                content.update(f"{source.sha256} {name}\n".encode())
        files = {source.path: source.sha256 for source in self.files}
        return {folder: content.hexdigest() for folder, content in listed.items()} | files
