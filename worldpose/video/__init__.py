"""Video: frames by their exact number, and clips written from pictures (PyAV).

Input: a video file, or pictures. Output: pictures by frame number and their times, or a file.
"""

from worldpose.video.frame_index import FrameIndex, index_frames
from worldpose.video.reading import VideoReader
from worldpose.video.writing import write_video

__all__ = ["FrameIndex", "VideoReader", "index_frames", "write_video"]
