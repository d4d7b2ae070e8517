"""Video input by exact frame number, and video output from images (PyAV).

Input: a video file, a folder of images, or images. Output: images by frame number and their times,
or a file.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldpose.video.files import VideoReader as VideoReader


def __getattr__(name: str) -> object:
    if name == "VideoReader":  # PyAV is imported for it alone
        from worldpose.video import files

        return files.VideoReader
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
