"""Names of video files."""

from __future__ import annotations

from pathlib import PurePath
from typing import Final

VIDEO_SUFFIXES: Final = (
    *(".3gp", ".avi", ".f4v", ".flv", ".m2t", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4"),
    *(".mpeg", ".mpg", ".mts", ".mxf", ".ogv", ".trp", ".ts", ".vob", ".webm", ".wmv"),
)


def is_video(path: str | PurePath) -> bool:
    """Return whether a file's name has the ending of a video, in any case."""
    return PurePath(path).suffix.lower() in VIDEO_SUFFIXES
