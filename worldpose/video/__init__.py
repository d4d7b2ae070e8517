"""Video input by exact frame number, and video output from images (PyAV).

Input: a video file, a folder of images, or images. Output: images by frame number and their times,
or a file.
"""

from worldpose.video.folder import ImageFolder, index_video, open_video
from worldpose.video.reading import FrameIndex, VideoReader, index_frames
from worldpose.video.writing import write_video

__all__ = [
    "FrameIndex",
    "ImageFolder",
    "VideoReader",
    "index_frames",
    "index_video",
    "open_video",
    "write_video",
]
