"""Frames of videos with proposed labels, for correction before fine-tuning."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worldpose.detection import DetectionSettings, load_detectors, load_pose
from worldpose.errors import InputError, UsageError
from worldpose.training.labels import propose_labels
from worldpose.video import open_video


def propose(videos: Sequence[Path], every: int, folder: Path, settings: DetectionSettings) -> int:
    """Write every n-th frame of videos with proposed labels; return the number of frames.

    Args:
        videos: video files or folders of images, all of one image size.
        every: step between frames.
        folder: absent or empty.
        settings: detectors that propose the labels.

    Raises:
        UsageError: the folder is not empty.
        InputError: two videos have the same name or different sizes, or one is damaged.
    """
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(
            str(folder),
            expected="an absent or empty folder",
            found="files",
            todo="Choose another folder: corrected labels are never overwritten.",
        )
    if len({video.stem for video in videos}) < len(videos):
        raise InputError(
            "videos",
            expected="files of different names",
            found=", ".join(video.name for video in videos),
            todo="Rename one: the images of its frames are named after it.",
        )
    frames = _frames(videos, every)
    return len(
        propose_labels(frames, load_detectors(settings), load_pose(settings), folder, settings)
    )


def _frames(videos: Sequence[Path], every: int) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    shape: tuple[int, ...] | None = None
    for video in videos:
        with open_video(video) as reader:
            for number in range(0, len(reader), every):
                picture = reader.frame(number)
                if shape is not None and picture.shape != shape:
                    raise InputError(
                        str(video),
                        expected=f"frames of {shape[1]} x {shape[0]}, as in the previous videos",
                        found=f"{picture.shape[1]} x {picture.shape[0]}",
                        todo="Label videos of another size in a separate folder.",
                    )
                shape = picture.shape
                yield f"{video.stem}_{number:06d}", picture
