"""Releases, their checks and statistics, and the settings of baseline methods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

from pydantic import Field, JsonValue

from data_contracts.conventions import CONVENTIONS, Conventions
from data_contracts.records import (
    CONTRACT_VERSION,
    Amount,
    Count,
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
from data_contracts.run import StoredFile
from data_contracts.triangulation import CameraChange
from data_contracts.usability import Usability

EXPORT_PURPOSES: Final[Mapping[str, str]] = {
    "joints": "joints with covariances for numpy",
    "coco": "keypoints per camera image, for training and labelling tools",
    "alphapose": "26 points of Halpe per camera image, for MotionBERT and others",
    "worldpose": "SMPL bodies and cameras as in the WorldPose data set",
    "positions": "a table of positions and speeds on the pitch",
    "minimap": "a video of the pitch from above",
    "trc": "markers for OpenSim",
    "c3d": "markers for motion capture programs such as Visual3D",
    "bvh": "a skeleton in motion for Blender and game engines",
    "mot": "joint angles for OpenSim",
    "gltf": "a 3D scene of bodies and cameras for Blender and the web",
    "usd": "a 3D scene for Omniverse, Houdini and Unreal",
    "csv": "tables of joints, people and strides for spreadsheets and R",
    "parquet": "the tables of csv with types, for pandas and databases",
    "viewer": "a 3D view in one file, for any browser without a network",
    "challenge": "the files of the pose challenge, with a submission",
    "challenge-2025": "the files of the pose challenge of 2025",
    "tracks": "boxes in MOTChallenge lines for other methods",
    "slahmr-cameras": "the broadcast camera for SLAHMR",
    "rerun": "a recording for the rerun viewer",
}
"""Format to what its files are for."""
EXPORT_FORMATS: Final = tuple(EXPORT_PURPOSES)
"""Names that `worldpose export --format` accepts."""


class ReleasedClip(Record):
    """One clip of a release."""

    first_frame: Frame
    """Match frame of the first row of every array."""
    frame_count: Count
    person_ids: tuple[PersonId, ...]
    """People in the order of every person dimension."""
    origins: dict[str, Count]
    """Number of joints by origin; the origin of each joint is in origins/<clip>.npz."""


class ReleaseManifest(Record):
    """A named, frozen run: the same name, run and licence give the same bytes."""

    contract: Literal[1] = CONTRACT_VERSION
    release: Name
    match_id: Name
    run_id: Name
    formats: tuple[str, ...]
    stage: str | None = None
    """Requested stage of the joints; None = the best available."""
    definition: Literal["body", "detector"] = "detector"
    """Definition of the joints of bodies, that of the detector in older releases."""
    fps: FramesPerSecond
    """[1/s]"""
    clips: dict[str, ReleasedClip]
    pictures: dict[str, tuple[ImageLength, ImageLength]]
    """Width and height [px] of every camera's images."""
    pitch: bool
    """Whether the world frame is that of a pitch; otherwise it is that of the calibration."""
    body_model: str | None
    """Name and version of the body model of all poses; betas are valid for it alone."""
    conventions: Conventions = CONVENTIONS
    licence: str = Field(min_length=1)
    """Licence text of the data."""
    usability: Usability
    """Verdict on the results."""
    worldpose: str
    """Version that wrote the release."""
    versions: dict[str, str]
    """Python and numeric libraries that computed it."""
    settings: dict[str, dict[str, JsonValue]]
    """Stage to all its settings."""
    results: dict[str, Key]
    """Stored results in the release: `stage/unit` to key."""
    files: tuple[StoredFile, ...]
    """With paths relative to the manifest."""


class Finding(Record):
    """One fault of a data set."""

    fault: str
    """Its name, such as `transposed_rotation`; docs/reference/formats.md lists them."""
    kind: Literal["convention", "damage", "plausibility"]
    where: tuple[str, ...]
    """Files or clips, and cameras."""
    says: str
    """Description of the fault, a sentence."""
    figures: dict[str, Number] = {}
    """Metrics that decided, with the unit in the name."""


class ClipFigures(Record):
    """Metrics of one clip."""

    frames: Count
    persons: Count
    sources: tuple[str, ...]
    """Files with 3D points."""
    cameras: Count
    compared: Count
    """2D points that were compared with 3D points."""
    reprojection_median_px: Amount | None = None
    """Median reprojection error of the worst pair of a source and a camera; None without visible 2D
    points."""
    plausible_share: Share | None = None
    """Share of bodies that are near the ground, head up, and within the pitch's bounds."""


class CheckReport(Record):
    """The outcome of a check."""

    contract: Literal[1] = CONTRACT_VERSION
    clips: dict[str, ClipFigures]
    findings: tuple[Finding, ...]
    """Empty if there is no fault."""
    notes: tuple[str, ...] = ()
    """What was assumed, or could not be compared."""


class BaselineSettings(Record):
    """The paper's settings of the baseline methods."""

    boxes: str = "tracks/<clip>.txt"
    """Boxes given to GLAMR and SLAHMR instead of their own detection."""
    cameras: str = "slahmr/cameras/<clip>/shot-0/cameras.npz"
    """Cameras given to SLAHMR in its variant with true cameras."""
    glamr_pictures: Literal["whole video"] = "whole video"
    """GLAMR optimises all images of a clip together."""
    slahmr_max_num_tracks: Count = 30
    """MAX_NUM_TRACKS of SLAHMR's preprocessing, raised from 12 to keep all players."""
    humans4d_confidence: Share = 0.5
    """Minimum confidence of 4DHumans' detections [0..1], lowered so that all players are found."""
    slahmr_floor_type: Literal["shared"] = "shared"
    """One floor for all people."""
    slahmr_est_floor: bool = True
    """The floor's normal is estimated: the camera looks down a little."""
    slahmr_cameras: Literal["DROID-SLAM over the whole video"] = "DROID-SLAM over the whole video"
    """Where SLAHMR's own cameras come from."""
    slahmr_chunk_frames: Count = 100
    """Images that SLAHMR optimises at a time [frame], each chunk independently."""


class ClipStatistics(Record):
    """Size of one clip."""

    frames: Count
    seconds: Amount
    """[s]"""
    persons: Count
    """People present in at least one frame."""
    poses: Count
    """Bodies of all people in all frames."""
    trajectories_m: tuple[Amount, ...]
    """Path length of every person over the ground [m]."""
    camera: Literal["S", "M", "M+Z"] | None = None
    """Whether the camera of the images is static, moves, or moves and zooms."""


class DataSetStatistics(Record):
    """Size of a data set, as the paper counts."""

    contract: Literal[1] = CONTRACT_VERSION
    clips: dict[str, ClipStatistics]
    frames: Count
    """Frames; several views of one frame count once."""
    minutes: Amount
    """[min]"""
    poses: Count
    subjects: Count | None = None
    """Different people; None if nothing tells who is who."""
    distance_km: Amount
    """Path length of all people while they are in the data [km]."""
    subjects_per_frame: Amount | None
    """Mean number of people per frame; None without frames."""
    speed_m_s: Amount | None
    """Mean speed of the person, over all poses [m/s]; None without poses."""
    longest_trajectory_m: Amount | None
    """[m]"""
    camera: Literal["S", "M", "M+Z"] | None
    """The most general motion among the clips' cameras."""


Split = Literal["train", "val", "test"]
"""Part of a data set; a match is in one."""


class RigCamera(Record):
    """A static camera in one clip of a data set."""

    image_size: tuple[ImageLength, ImageLength]
    """Width and height [px]."""
    visible: Share | None
    """Mean share of a person's joints that it shows [1]; None without people, or if the view
    changes."""
    lens: dict[str, str | Number | None] | None = None
    """Model of another lens than Brown's, and the largest errors of the five coefficients [px]; if
    they are null, the `reason` why the camera has no file."""
    changes: tuple[CameraChange, ...] = ()
    """How the view changes within the clip; the camera's file is from before."""


class ReleasedSequence(Record):
    """One clip of a data set of several matches."""

    split: Split
    match_id: Name
    run_id: Name
    clip_id: Name
    usability: Usability
    """Verdict on the run's results."""
    first_frame: Frame
    """Match frame of the first row of every array."""
    frames: Count
    """Rows of every array; they last frames / fps seconds."""
    fps: FramesPerSecond
    """[1/s]"""
    body_model: str
    """Body model of the poses."""
    subjects: tuple[str, ...]
    """The person of each row of poses, joints and boxes: the same name is the same person."""
    views: dict[str, tuple[ImageLength, ImageLength]]
    """Width and height [px] of each broadcast camera's images, by the name of its files."""
    rig: dict[Name, RigCamera] | None = None
    """Static cameras; None in older releases, and in the test part, whose truth has rigs.json."""
    footage: dict[str, StoredFile]
    """Video by the same names: the copy, or the file in the match folder."""
    first_images: dict[str, Frame]
    """Image of the video in the clip's first frame, from 0."""


class DataSetManifest(Record):
    """release.json: what a data set of several matches has, and what it hides."""

    contract: Literal[1] = CONTRACT_VERSION
    release: Name
    worldpose: str
    """Version that wrote the data set."""
    conventions: Conventions = CONVENTIONS
    pitch: bool
    """Whether all worlds are those of a pitch."""
    licences: dict[str, str]
    """Licence text by kind of file: poses, joints, cameras, boxes, footage."""
    clips: dict[str, ReleasedSequence]
    statistics: DataSetStatistics
    """Without the test part, whose statistics are with its truth."""
    files: tuple[StoredFile, ...]
    """Relative to this file."""
    hidden: tuple[StoredFile, ...]
    """The truth of the test part, relative to its own folder."""
