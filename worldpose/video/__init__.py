"""Video: frames by their exact number, and clips written from pictures (PyAV).

Input: a video file, a folder of images, or pictures. Output: pictures by number and their times,
or a file.
"""

from worldpose.video.folder import ImageFolder, index_video, open_video
from worldpose.video.frame_index import FrameIndex, index_frames
from worldpose.video.reading import VideoReader
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
