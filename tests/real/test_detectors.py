"""A detector of another project on a real frame; skipped where the data is absent.

WORLDPOSE_TEST_DATA names a folder with `static_pair` and `weights`.
"""

import cv2
import numpy as np
from real_data import GIVEN, needs

from worldpose.detection.onnx_detectors import load_onnx_detector
from worldpose.detection.views import TiledDetector

NET, VIDEO = "weights/yolox_nano.onnx", "static_pair/left_camera.mp4"

pytestmark = needs(NET, VIDEO)

PLAYERS = np.array(
    [
        *((2218, 803), (2367, 813), (2439, 813), (2625, 847), (2748, 856), (2554, 980)),
        *((2188, 1201), (1252, 888), (2088, 915), (2071, 866), (1738, 1009), (1783, 1058)),
        *((2840, 995), (2778, 1068), (2997, 815), (2598, 760), (3034, 764)),
    ]
)
"""Middles of the players and the referee in the first frame, by eye [px]."""


def test_a_yolox_file_finds_the_players_of_a_real_frame():
    shown, image = cv2.VideoCapture(str(GIVEN / VIDEO)).read()
    assert shown
    detector = TiledDetector(load_onnx_detector(GIVEN / NET), (1.0,), 0.25, 0.7)
    (found,) = detector.detect([np.ascontiguousarray(image[..., ::-1])])
    boxes = found.boxes[found.scores >= 0.4]
    inside = (boxes[:, None, :2] < PLAYERS) & (boxes[:, None, 2:] > PLAYERS)
    alone = inside.all(axis=2)[(inside.all(axis=2).sum(axis=1) == 1)]
    assert alone.any(axis=0).sum() >= 16
