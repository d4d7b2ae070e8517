"""A folder of images gives single images as a video does."""

import cv2
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.video.folder import open_video


def test_one_picture_of_a_folder_is_read_by_its_number(tmp_path):
    for number in (5, 6):
        picture = np.zeros((4, 6, 3), np.uint8)
        picture[..., 2] = 10 * number  # red, as OpenCV writes it
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    (tmp_path / "7.png").write_bytes(b"no picture")
    with open_video(tmp_path) as video:
        assert video.frame(1)[0, 0].tolist() == [60, 0, 0]
        with pytest.raises(InputError, match=r"7\.png.*PNG"):
            video.frame(2)
