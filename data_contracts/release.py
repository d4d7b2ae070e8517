"""What leaves the project: releases, their checks, their statistics, what other methods are fed."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from data_contracts.conventions import CONVENTIONS, Conventions
from data_contracts.records import (
    CONTRACT_VERSION,
    Amount,
    Count,
    Digest,
    Frame,
    FramesPerSecond,
    ImageLength,
    Key,
    Name,
    Number,
    PersonId,
    Record,
    Share,
)


class ReleasedFile(Record):
    """One file of a release."""

    path: str
    """Relative to the manifest, with forward slashes."""
    size: Count
    """[byte]"""
    sha256: Digest


class ReleasedClip(Record):
    """One clip of a release."""

    first_frame: Frame
    """Match frame of the first row of every array."""
    frame_count: Count
    person_ids: tuple[PersonId, ...]
    """People in the order of every person dimension."""
    origins: dict[str, Count]
    """How many joints are of which origin; each joint's is in origins/<clip>.npz."""


class ReleaseManifest(Record):
    """A named, frozen run: the same name, run and licence give the same bytes."""

    contract: Literal[1] = CONTRACT_VERSION
    release: Name
    match_id: Name
    run_id: Name
    formats: tuple[str, ...]
    stage: str | None = None
    """Whose joints were asked for; None = the best there are."""
    fps: FramesPerSecond
    """[1/s]"""
    clips: dict[str, ReleasedClip]
    pictures: dict[str, tuple[ImageLength, ImageLength]]
    """Width and height [px] of every camera's picture."""
    pitch: bool
    """Whether the world is a pitch's; without one it is that of the cameras' calibration."""
    body_model: str | None
    """Name and version of the body model of all poses; betas of another mean nothing."""
    conventions: Conventions = CONVENTIONS
    licence: str = Field(min_length=1)
    """The text under which the owner of the data gives it out."""
    worldpose: str
    """Version that wrote the release."""
    versions: dict[str, str]
    """Python and numeric libraries that computed it."""
    settings: dict[str, dict[str, JsonValue]]
    """Stage to all its settings."""
    results: dict[str, Key]
    """Stored results that it was made from: `stage/unit` to key."""
    files: tuple[ReleasedFile, ...]


class Finding(Record):
    """One thing that is wrong with a data set."""

    fault: str
    """Its name, such as `transposed_rotation`; docs/reference/formats.md lists them."""
    kind: Literal["convention", "damage", "plausibility"]
    where: tuple[str, ...]
    """Files or clips, and cameras."""
    says: str
    """What was found, in a sentence."""
    figures: dict[str, Number] = {}
    """What decided, with the unit in the name."""


class ClipFigures(Record):
    """What was measured in one clip."""

    frames: Count
    persons: Count
    sources: tuple[str, ...]
    """Files with 3D points."""
    cameras: Count
    compared: Count
    """2D points that were compared with 3D points."""
    reprojection_median_px: Amount | None = None
    """Of the worst pair of a source and a camera; None where there is no 2D, or nothing is seen."""
    plausible_share: Share | None = None
    """Of bodies near the ground, head up, within the pitch's bounds."""


class CheckReport(Record):
    """The outcome of a check."""

    contract: Literal[1] = CONTRACT_VERSION
    clips: dict[str, ClipFigures]
    findings: tuple[Finding, ...]
    """Empty where nothing is wrong."""


class BaselineSettings(Record):
    """How the paper ran the methods that it compares with (E6)."""

    boxes: str = "tracks/<clip>.txt"
    """Boxes that GLAMR and SLAHMR get instead of finding people themselves."""
    cameras: str = "slahmr/cameras/<clip>/shot-0/cameras.npz"
    """Cameras that SLAHMR gets in its variant with true ones."""
    glamr_pictures: Literal["whole video"] = "whole video"
    """GLAMR optimises all pictures of a clip together."""
    slahmr_max_num_tracks: Count = 30
    """MAX_NUM_TRACKS of SLAHMR's preprocessing, 12 as it comes: all players are to be kept."""
    humans4d_confidence: Share = 0.5
    """Least confidence of 4DHumans' detections [0..1], lowered so that all players are found."""
    slahmr_floor_type: Literal["shared"] = "shared"
    """One floor for everybody."""
    slahmr_est_floor: bool = True
    """The floor's normal is estimated: the camera looks down a little."""
    slahmr_cameras: Literal["DROID-SLAM over the whole video"] = "DROID-SLAM over the whole video"
    """Where SLAHMR's own cameras come from."""
    slahmr_chunk_frames: Count = 100
    """Pictures that SLAHMR optimises at a time, each piece on its own."""


class ClipStatistics(Record):
    """How much there is in one clip."""

    frames: Count
    seconds: Amount
    """[s]"""
    persons: Count
    """People who are there in at least one frame."""
    poses: Count
    """Bodies of all people in all frames."""
    trajectories_m: tuple[Amount, ...]
    """Length of every person's way over the ground [m]."""
    camera: Literal["S", "M", "M+Z"] | None = None
    """Whether the camera of the pictures stands still, moves, or moves and zooms."""


class DataSetStatistics(Record):
    """How much there is in a data set, as the paper counts (X1, X2)."""

    contract: Literal[1] = CONTRACT_VERSION
    clips: dict[str, ClipStatistics]
    frames: Count
    """Pictures, several views counted once."""
    minutes: Amount
    """[min]"""
    poses: Count
    distance_km: Amount
    """That all people went, while they are in the data [km]."""
    subjects_per_frame: Amount | None
    """Mean number of people in a frame; None without frames."""
    speed_m_s: Amount | None
    """Mean over all poses of how fast their person goes [m/s]; None without poses."""
    longest_trajectory_m: Amount | None
    """[m]"""
    camera: Literal["S", "M", "M+Z"] | None
    """The most that any clip's camera does."""
