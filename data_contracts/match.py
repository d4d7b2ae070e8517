"""match.yaml and the registration of a match folder."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Final, Literal, NamedTuple, Self

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
    Positive,
    Record,
)

TEAM_SIZE: Final = 11
"""Players of a team on the pitch (Laws of the Game, 3)."""


def one_error(kind: str, forms: str) -> WrapValidator:
    """Return a validator of values of two forms, whose error names both at once."""

    def validate(value: object, read: ValidatorFunctionWrapHandler) -> object:
        if isinstance(value, list):  # here also strict rules see Python's lists, of a JSON file
            value = tuple(tuple(pair) if isinstance(pair, list) else pair for pair in value)
        try:
            return read(value)
        except ValidationError as error:
            raise PydanticCustomError(kind, f"Input should be {forms}") from error

    return WrapValidator(validate)


ClockOffset = Annotated[
    FrameOffset | tuple[tuple[Frame, FrameOffset], ...],
    one_error("clock_offset", "a number, or pairs [match frame, number]"),
]
"""A camera's frame minus the match frame; a number, or rising pairs of a match frame and a number,
with linear change between them."""

Cameras = Annotated[
    Name | tuple[Name, ...] | None, one_error("cameras", "the name of a camera, or a list of names")
]
"""The name of a camera, or those of several."""

CameraOffsets = Annotated[
    FrameOffset | dict[Name, FrameOffset],
    one_error("camera_offsets", "a number, or a number for each broadcast camera"),
]
"""An offset of the only camera, or of each one by its name [frame]."""

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
    [match frame, offset] describe a clock that drifts, or frames that a recorder lost."""
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
        if self.kind == "broadcast":
            if offset == 0.0:
                return self
        elif not isinstance(offset, tuple):
            if offset == int(offset):
                return self
            todo = f"a static camera's must be whole, or in pairs as [[0, {offset:g}]]"
        else:
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
    broadcast: Cameras = None
    """The broadcast camera that filmed this clip, if any, or a list of several."""
    broadcast_offset_frames: CameraOffsets = 0.0
    """Frame of the broadcast clip's own video at the clip's first frame; of several broadcast
    cameras a mapping from each camera to its number."""
    broadcast_smooth_weight: Positive = 1.0
    """Factor on the smoothness of focal length and distortion of the clip's broadcast cameras [1],
    whose own weight comes from the video."""
    people: dict[PersonId, Name] = {}
    """Person ids of the clip's tracks, with their ids in the roster, where known."""

    @model_validator(mode="after")
    def _offset_of_each(self) -> Self:
        cameras, offset = self.moving_cameras, self.broadcast_offset_frames
        wrong = "an empty list" if cameras == () and self.broadcast is not None else ""
        if len({*cameras}) < len(cameras):
            wrong = f"a camera twice: {list(cameras)}"
        if wrong:
            raise ValueError(f"clip {self.id} has as broadcast {wrong}; name each camera once")
        named = list(offset) if isinstance(offset, dict) else cameras if offset else ()
        if isinstance(offset, dict) and {*named} != {*cameras}:
            raise ValueError(
                f"clip {self.id} has broadcast_offset_frames of {sorted(named)}; expected those of "
                f"its broadcast cameras {sorted(cameras)}"
            )
        if not isinstance(offset, dict) and len(named) > 1:
            raise ValueError(
                f"clip {self.id} has broadcast_offset_frames {offset:g} and several broadcast "
                f"cameras; give each one's, as {{{cameras[0]}: {offset:g}, {cameras[1]}: 0}}"
            )
        return self

    @property
    def moving_cameras(self) -> tuple[str, ...]:
        """The broadcast cameras that filmed this clip."""
        named = self.broadcast
        return (named,) if isinstance(named, str) else named or ()


class BroadcastView(NamedTuple):
    """A broadcast camera in one clip: a unit of the stages of broadcast cameras."""

    clip: ClipSpec
    camera: CameraSpec
    offset: float
    """Frame of its video at the clip's first frame."""


def _view_name(clip: ClipSpec, camera: str) -> str:
    return clip.id if len(clip.moving_cameras) == 1 else f"{clip.id}.{camera}"


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
    venue: Name | None = None
    """The stadium or laboratory, whose settings the project keeps."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ids = [camera.id for camera in self.cameras] + [clip.id for clip in self.clips]
        for clip in self.clips:
            views = [_view_name(clip, name) for name in clip.moving_cameras]
            ids += views if len(views) > 1 else []
        twice = sorted({name for name in ids if ids.count(name) > 1})
        if twice:
            raise ValueError(f"ids of cameras and clips must differ; used twice: {twice}")
        broadcast = {camera.id for camera in self.cameras if camera.kind == "broadcast"}
        for clip in self.clips:
            for name in clip.moving_cameras:
                if name not in broadcast:
                    raise ValueError(
                        f"clip {clip.id} names broadcast camera {name!r}; "
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

    @property
    def broadcast_views(self) -> dict[str, BroadcastView]:
        """The broadcast cameras of each clip, by the name of their units and files.

        It is the clip's id, or `<clip>.<camera>` if several broadcast cameras filmed the clip.
        """
        cameras = {camera.id: camera for camera in self.cameras}
        found = {}
        for clip in self.clips:
            offsets = clip.broadcast_offset_frames
            for name in clip.moving_cameras:
                offset = offsets[name] if isinstance(offsets, dict) else offsets
                found[_view_name(clip, name)] = BroadcastView(clip, cameras[name], offset)
        return found

    def broadcast_view(self, name: str) -> BroadcastView | None:
        """The broadcast view of this name; None without one, at once for a camera's id."""
        is_camera = any(camera.id == name for camera in self.cameras)
        return None if is_camera else self.broadcast_views.get(name)

    def views_of(self, clip_id: str) -> tuple[str, ...]:
        """The names of a clip's broadcast views."""
        return tuple(name for name, view in self.broadcast_views.items() if view.clip.id == clip_id)

    def filming_camera(self, owner: str) -> CameraSpec | None:
        """The static camera with this id, or the camera of the broadcast view of this name."""
        view = self.broadcast_view(owner)
        static = {camera.id: camera for camera in self.static_cameras}
        return static.get(owner) if view is None else view.camera

    def clips_of(self, owner: str) -> tuple[ClipSpec, ...]:
        """The clips that a static camera films, which are all, or the one of a broadcast view."""
        view = self.broadcast_view(owner)
        return self.clips if view is None else (view.clip,)

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
