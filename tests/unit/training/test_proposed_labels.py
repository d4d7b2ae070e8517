"""Frames are labelled whatever form their video has."""

import cv2
import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People
from worldpose.detection.settings import DetectionSettings
from worldpose.training import labels
from worldpose.training.labels import read_labels


class Brightness:
    """Sees one person, whose keypoints say how bright the image is."""

    view_size = None

    def detect(self, pictures):
        return [People(np.array([[1.0, 1.0, 9.0, 19.0]]), np.array([0.9])) for _ in pictures]

    def estimate(self, picture, boxes):
        value = float(picture[0, 0, 0])
        return KeypointDetections.from_keypoints(
            np.full((len(boxes), 17, 2), value), np.ones((len(boxes), 17))
        )


@pytest.fixture(autouse=True)
def detectors(monkeypatch):
    monkeypatch.setattr(labels, "load_detectors", lambda settings: [Brightness()])
    monkeypatch.setattr(labels, "load_pose", lambda settings: Brightness())


def images(folder, size=(20, 24)):
    folder.mkdir()
    for number in range(5):
        cv2.imwrite(str(folder / f"{number:04d}.png"), np.full((*size, 3), 10 * number, np.uint8))
    return folder


def test_a_folder_of_images_is_labelled_as_a_video_is(tmp_path):
    videos = [images(tmp_path / "cam00"), images(tmp_path / "cam01")]
    assert labels.propose_labels(videos, 2, tmp_path / "labels", DetectionSettings()) == 6
    found = read_labels(tmp_path / "labels" / "labels.json")
    names = [f"{camera}_{number:06d}.png" for camera in ("cam00", "cam01") for number in (0, 2, 4)]
    assert [picture.path.name for picture in found] == names
    assert [picture.keypoints[0, 0, 0] for picture in found] == [0.0, 20.0, 40.0] * 2


def test_a_detector_with_a_fixed_size_gets_views_of_the_frame(tmp_path, monkeypatch):
    class Views(Brightness):
        view_size = (12, 10)

        def detect(self, pictures):
            assert {picture.shape for picture in pictures} == {(10, 12, 3)}
            return [People(np.array([[4.0, 4.0, 6.0, 8.0]]), np.array([0.9]))] * len(pictures)

    monkeypatch.setattr(labels, "load_detectors", lambda settings: [Views()])
    settings = DetectionSettings(zooms=(0.5,))  # the whole frame alone
    labels.propose_labels([images(tmp_path / "cam00")], 5, tmp_path / "labels", settings)
    (found,) = read_labels(tmp_path / "labels" / "labels.json")
    np.testing.assert_allclose(found.boxes, [[8.5, 8.5, 12.5, 16.5]])
