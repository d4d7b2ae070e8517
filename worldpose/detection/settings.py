"""Settings of people detection."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from data_contracts.records import Record


def _one_or_more(value: object) -> object:
    return (value,) if isinstance(value, str) else value


Zoom = Annotated[float, Field(gt=0, le=16)]
"""Factor on the size of an image [1]."""
ClassNumber = Annotated[int, Field(ge=0, le=10_000)]
"""Class of a detector [1]."""


class DetectionSettings(Record):
    """Settings of `detection` (paper: refinement of 2D detection results)."""

    detector: Annotated[tuple[str, ...], BeforeValidator(_one_or_more)] = Field(
        default=("embedded",), min_length=1
    )
    """Detectors of people: `embedded`, `embedded:FILE`, `model:NAME` (see `worldpose models`),
    `transformers:FOLDER`, `onnx:FILE`, or `onnx-FORM:FILE` where the net's outputs do not tell its
    form, for example `onnx-rtmdet:FILE`; several form an ensemble whose boxes are fused."""
    person_classes: tuple[ClassNumber, ...] | None = Field(
        default=None, min_length=1, max_length=100
    )
    """Classes of people in ONNX detectors, and in transformers detectors whose names tell none [1];
    None: those whose names say so, or COCO's person."""
    pose: str = "embedded"
    """Estimator of keypoints, named in the same way."""
    flip_test: bool = False
    """Keypoints are the mean over the frame and its mirror image, in twice the time: a bias to one
    side cancels."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device that computes nets. There is no automatic choice: other devices give other bytes."""
    half: bool = False
    """Half precision, on a GPU only."""
    batch: int = Field(default=8, ge=1, le=1000)
    """Frames per detector batch [1]; bounds memory, changes no result. With `stride`, batches are
    smaller where more than 32 frames would wait for a full one."""
    stride: int = Field(default=1, ge=1, le=100)
    """People are detected in every `stride`-th frame; boxes between are interpolated linearly
    [frame]. Keypoints are estimated in every frame."""
    fusion: Literal["suppress", "weighted"] = "weighted"
    """How an ensemble's boxes of one person become one: the best alone, or their mean weighted by
    score. Both are of the paper's family; a single detector always uses suppression."""
    nms_iou: float = Field(default=0.7, gt=0, lt=1)
    """Two boxes with a larger intersection over union are of one person [1]. Players in a group
    reach 0.6 and more; a duplicate box that passes shows the same pose."""
    zooms: tuple[Zoom, ...] = Field(default=(1.0,), max_length=4)
    """For a detector that takes views of a fixed size: frames are scaled by each factor and cut
    into overlapping views, in addition to one view of the whole frame [1]."""
    view_overlap: float = Field(default=0.25, ge=0, lt=0.9)
    """Share of a view that its neighbour shows too [1]; a person of that size is whole in one."""
    high_score_threshold: float = Field(default=0.4, gt=0, lt=1)
    """Minimum score of a box that is a person and may begin a track [1]."""
    low_score_threshold: float = Field(default=0.1, gt=0, lt=1)
    """Minimum score of a box that is a person if a track predicts one (ByteTrack's second pass)."""
    track_buffer_frames: int = Field(default=25, ge=1, le=10000)
    """Time after which an unseen track ends [frame]."""
    max_gap_frames: int = Field(default=8, ge=0, le=1000)
    """Gaps of a track up to this length are filled with linearly interpolated boxes [frame]. Frames
    are buffered for as long, which costs memory. A third of a second is a step of a sprint."""
    min_hits: int = Field(default=2, ge=1, le=1000)
    """A track with fewer sightings, where as many frames were searched, is a flicker [1]. Frames
    are buffered until a track can have as many: `stride` times `min_hits` - 1 images in memory."""
    pitch_margin_m: float = Field(default=2.5, ge=0, le=1000)
    """People whose feet are farther outside of the pitch than this are crowd [m]. Throw-ins,
    sprints over the line and assistants, 1.5 m out, stay: the position of a far foot is accurate to
    1 m. People waiting behind the lines stand from 2.5 m on, boards 3 to 6 m out."""
    find_occluded: bool = False
    """The embedded pose net also searches boxes shifted to the side of every detected person, where
    a detector sees the person in front alone. This finds more people, and more false boxes that are
    half of two people; poses take twice as long. Not with `flip_test` or another pose net, and not
    where boxes are given."""
    landmarks: bool = False
    """A second net also finds 64 landmarks of the surface, heels and toes. It takes as long as the
    net of joints, which stay as they are. Off: bodies hardly get better by these points yet
    (docs/results/measured.md)."""
    min_keypoint_confidence: float = Field(default=0.05, ge=0, lt=1)
    """A keypoint below this confidence was not found [1]."""
    oks_nms: float = Field(default=0.85, ge=1e-6, le=1)
    """If two poses in a frame are more similar than this, the pose with the better box stays [1,
    COCO's object keypoint similarity]."""
    max_people: int = Field(default=64, ge=1, le=1024)
    """Most people per frame; those with the best scores stay. Given boxes all stay."""

    @property
    def longest_gap(self) -> int:
        """Longest time between two sightings of a track that is filled [frame]."""
        return max(self.max_gap_frames, self.stride)

    @model_validator(mode="after")
    def _refuse_occluded_search_without_bundled_net(self) -> Self:
        if self.find_occluded and self.flip_test:
            raise ValueError(
                "detection.find_occluded and detection.flip_test exclude each other, because the "
                "flip test does not search for occluded people. Set one of them to false."
            )
        if self.find_occluded and self.pose.partition(":")[0] != "embedded":
            raise ValueError(
                "detection.find_occluded needs the bundled pose net (detection.pose=embedded), "
                f"but detection.pose is {self.pose!r}. Set detection.find_occluded to false."
            )
        return self


class RedetectionSettings(Record):
    """Settings of the search for missed people, and acceptance thresholds."""

    enabled: bool = True
    """Whether redetection runs; otherwise detections stay as they are."""
    min_height_px: float = Field(default=40.0, ge=1e-6, le=10000)
    """Least height of a box in the frame [px]: the accuracy of detectors is measured down to this
    height."""
    min_visible_share: float = Field(default=0.5, ge=0, le=1)
    """Share of the joints that must lie in the frame with no nearer body in front [1]: for occluded
    people a net returns the occluder."""
    max_uncertainty_m: float = Field(default=0.15, ge=1e-6, le=100)
    """Largest median standard deviation of the joints across the view at which a body is searched
    for [m]: about half a trunk's width."""
    min_confidence: float = Field(default=0.5, ge=1e-6, le=1)
    """Least mean confidence of the twelve surest keypoints of a result [1]."""
    max_deviation: float = Field(default=2.5, ge=1e-6, le=1e6)
    """Keypoints farther from the body, in standard deviations, are left out [1]; that of
    `filtering`, which would reject them afterwards."""
    min_inlier_share: float = Field(default=0.7, ge=0, le=1)
    """Share of a result's keypoints within `max_deviation` that makes it the person's [1]; more
    than `filtering` requires of detections, which do not depend on the body."""
    min_similarity: float = Field(default=0.7, ge=-1, le=1)
    """Least mean cosine between a result's bones and the body's [1]: 45 degrees."""
    oks_nms: float = Field(default=0.7, ge=1e-6, le=1)
    """A result more similar than this to a detection in the frame, or to another result, is a
    duplicate [1, COCO's object keypoint similarity]."""
