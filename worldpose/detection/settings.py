"""What a person may choose about finding people in pictures."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from data_contracts.records import Record


def _one_or_more(value: object) -> object:
    return (value,) if isinstance(value, str) else value


Zoom = Annotated[float, Field(gt=0, le=16)]
"""Factor on the size of an image [1]."""


class DetectionSettings(Record):
    """Settings of `detection` (paper: refinement of 2D detection results; D1-D3)."""

    detector: Annotated[tuple[str, ...], BeforeValidator(_one_or_more)] = Field(
        default=("embedded",), min_length=1
    )
    """Who finds people: `embedded`, `embedded:FILE`, `transformers:FOLDER` or `onnx:FILE`; several
    are an ensemble whose boxes are fused."""
    pose: str = "embedded"
    """Who finds keypoints; named in the same way."""
    mirrored: bool = False
    """Keypoints are the mean of two looks, at the picture and at its mirror image, in twice the
    time: what leans to one side is set right."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where nets are computed. Named, never guessed: other devices give other bytes."""
    half: bool = False
    """Half precision, on a GPU alone."""
    batch: int = Field(default=8, ge=1, le=1000)
    """Pictures that are looked at together [1]; bounds memory, changes no result."""
    stride: int = Field(default=1, ge=1, le=100)
    """People are looked for in every `stride`-th frame; between, their boxes move evenly [frame].
    Keypoints are found in every frame."""
    fusion: Literal["suppress", "weighted"] = "weighted"
    """How an ensemble's boxes of one person become one: the best alone, or their mean weighted by
    score. Both are of the paper's family; a single detector is always suppressed."""
    overlap: float = Field(default=0.7, gt=0, lt=1)
    """Two boxes with more of their union in common are of one person [1]. Players in a group reach
    0.6 and more; a second box of one person that is let through shows the same pose."""
    zooms: tuple[Zoom, ...] = Field(default=(1.0,), max_length=4)
    """For a detector that looks at views of a fixed size: pictures are scaled by each and cut into
    overlapping views, beside one view of the whole picture [1]."""
    view_overlap: float = Field(default=0.25, ge=0, lt=0.9)
    """Share of a view that its neighbour shows as well [1]; a person that size is whole in one."""
    sure: float = Field(default=0.4, gt=0, lt=1)
    """A box from this score on is a person, and may begin a track [1]."""
    doubtful: float = Field(default=0.1, gt=0, lt=1)
    """A box from this score on is a person where a track expects one (ByteTrack's second look)."""
    patience: int = Field(default=25, ge=1, le=10000)
    """Frames after which a track that nobody confirms is given up."""
    bridge: int = Field(default=8, ge=0, le=1000)
    """Gaps of a track up to this long are filled with boxes that move evenly [frame]. Pictures are
    held back for as long, which costs memory. A third of a second is a step of a sprint."""
    sightings: int = Field(default=2, ge=1, le=1000)
    """A track that was seen less often, where there were as many looks, is a flicker [1]."""
    pitch_margin_m: float = Field(default=2.5, ge=0, le=1000)
    """People whose feet are farther outside of the pitch than this are crowd (D2) [m]. Throw-ins,
    sprints over the line and assistants, 1.5 m out, stay: a far foot is known to 1 m. Who waits
    behind the lines goes from 2.5 m on, boards stand 3 to 6 m out."""
    beside: bool = False
    """The embedded pose net is asked, too, about places half beside everybody found, where a
    detector sees the one in front alone: more people are found, and more who are half of two;
    poses take twice as long. Not with `mirrored`."""
    least_keypoint: float = Field(default=0.05, ge=0, lt=1)
    """A keypoint below this confidence was not found [1]."""
    same_pose: float = Field(default=0.85, ge=1e-6, le=1)
    """Two poses of one frame more alike than this are one person, whose better box stays [1, COCO's
    object keypoint similarity]."""
    most_people: int = Field(default=64, ge=1, le=1024)
    """At most so many, the best scored, of a frame."""
