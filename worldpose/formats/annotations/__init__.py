"""Exchange of detections with external annotation tools.

Inputs and outputs: `AnnotatedImage`s; COCO keypoints JSON, CVAT for images XML 1.1 or Label Studio
JSON. `worldpose.review.detections` finds an annotator's changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeAlias, get_args

from worldpose.formats.annotations.annotated_images import (
    AnnotatedImage,
    ContentError,
    coco_bytes,
    decode_file,
    first_character,
    read_coco,
)
from worldpose.formats.annotations.programs import (
    cvat_bytes,
    label_studio_bytes,
    read_cvat,
    read_label_studio,
)

Format: TypeAlias = Literal["coco", "cvat", "label-studio"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)


class _Codec(NamedTuple):
    name: str
    suffix: str
    encode: Callable[[Sequence[AnnotatedImage]], bytes]
    decode: Callable[[bytes], list[AnnotatedImage]]


_CODECS: Final[dict[Format, _Codec]] = {
    "coco": _Codec("COCO keypoints JSON", ".json", coco_bytes, read_coco),
    "cvat": _Codec("CVAT for images XML 1.1", ".xml", cvat_bytes, read_cvat),
    "label-studio": _Codec("Label Studio JSON", ".json", label_studio_bytes, read_label_studio),
}


def format_suffix(form: Format) -> str:
    """Return the file name suffix of a format."""
    return _CODECS[form].suffix


def detect_format(content: bytes) -> Format:
    """Detect the format of a file from its first characters: XML, a list of tasks, or an object."""
    begin = first_character(content)
    return "cvat" if begin == b"<" else "label-studio" if begin == b"[" else "coco"


def write_annotations(
    path: Path, pictures: Sequence[AnnotatedImage], form: Format = "coco"
) -> None:
    """Write images of unique names in a format; an existing file is overwritten."""
    path.write_bytes(_CODECS[form].encode(pictures))


def read_annotations(path: Path, form: Format | None = None) -> list[AnnotatedImage]:
    """Return a file's images, in its order; InputError if invalid. Its content tells the format."""
    most = 1 << 28  # maximum file size [bytes], about that of a hundred thousand people

    def decode(content: bytes) -> list[AnnotatedImage]:
        pictures = _CODECS[form or detect_format(content)].decode(content)
        if len({picture.name for picture in pictures}) < len(pictures):
            raise ContentError("two images with one name")
        return pictures

    expected = " or ".join(codec.name for name, codec in _CODECS.items() if form in (None, name))
    todo = "Export it again from the annotator; docs/how-to/review.md says how."
    return decode_file(path, most, decode, expected, todo)
