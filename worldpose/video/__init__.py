"""Video input by exact frame number, and video output from images (PyAV).

Input: a video file, a folder of images, or images. Output: images by frame number and their times,
or a file.
"""

from pathlib import PurePath
from typing import TYPE_CHECKING, Final

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.video.files import FrameIndex, VideoReader, index_frames, write_video
    from worldpose.video.folder import ImageFolder, index_video, median_picture, open_video

__all__ = [
    "VIDEO_SUFFIXES",
    "FrameIndex",
    "ImageFolder",
    "VideoReader",
    "index_frames",
    "index_video",
    "is_video",
    "median_picture",
    "open_video",
    "write_video",
]

VIDEO_SUFFIXES: Final = (
    *(".3gp", ".avi", ".flv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg"),
    *(".mts", ".mxf", ".ts", ".webm", ".wmv"),
)


def is_video(path: str | PurePath) -> bool:
    """Return whether a file's name has the ending of a video, in any case, and is not hidden."""
    name = PurePath(path)
    return name.suffix.lower() in VIDEO_SUFFIXES and not name.name.startswith(".")


__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.video.files": (
            "FrameIndex",
            "VideoReader",
            "index_frames",
            "write_video",
        ),
        "worldpose.video.folder": (
            "ImageFolder",
            "index_video",
            "median_picture",
            "open_video",
        ),
    },
)
