"""Video input by exact frame number, and video output from images (PyAV).

Input: a video file, a folder of images, or images. Output: images by frame number and their times,
or a file.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.video.files import FrameIndex, VideoReader, index_frames, write_video
    from worldpose.video.folder import ImageFolder, index_video, median_picture, open_video
    from worldpose.video.names import VIDEO_SUFFIXES, is_video

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
        "worldpose.video.names": ("VIDEO_SUFFIXES", "is_video"),
    },
)
