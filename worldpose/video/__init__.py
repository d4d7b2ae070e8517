"""Video input by exact frame number, and video output from images (PyAV).

Input: a video file, a folder of images, or images. Output: images by frame number and their times,
or a file.
"""

from worldpose.video.files import FrameIndex, VideoReader, index_frames, write_video
from worldpose.video.folder import ImageFolder, index_video, median_picture, open_video

__all__ = [
    "FrameIndex",
    "ImageFolder",
    "VideoReader",
    "index_frames",
    "index_video",
    "median_picture",
    "open_video",
    "write_video",
]
