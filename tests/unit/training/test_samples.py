from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from worldpose.detection.bundled_nets import CROP, KeypointNet, PeopleNet
from worldpose.geometry.boxes import box_iou
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.keypoint_training import (
    KeypointCrops,
    keypoint_batch,
    keypoint_loss,
    labelled_people,
)
from worldpose.training.labels import LabelledPicture, PictureCache
from worldpose.training.people_training import (
    PeopleWindows,
    box_overlap,
    boxes_in_window,
    draw_targets,
    people_batch,
    people_loss,
)

AS_IS = AugmentationSettings(strength=0, recoloured=0, grey=0, fog=0, soft=0, coded=0, grain=0)
NOSE, LEFT_EAR, RIGHT_EAR = 0, 3, 4


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A grey image of one box of 60 x 120 px: a red left ear and a blue right one."""
    path: Path = tmp_path_factory.mktemp("pictures") / "a.png"
    picture = np.full((300, 400, 3), 60, dtype=np.uint8)
    left, right = (230, 120), (190, 150)
    cv2.circle(picture, left, 6, (0, 0, 255), -1)
    cv2.circle(picture, right, 6, (255, 0, 0), -1)
    cv2.imwrite(str(path), picture)
    keypoints = np.full((1, 17, 2), np.nan)
    keypoints[0, LEFT_EAR], keypoints[0, RIGHT_EAR] = left, right
    visible = np.where(np.isfinite(keypoints[..., 0]), 2, 0).astype(np.int8)
    box = np.array([[180.0, 90.0, 240.0, 210.0]])
    return LabelledPicture(path, box, keypoints, visible, np.array([False]))


def test_an_image_without_augmentation_stays(labelled):
    picture = PictureCache()[labelled.path]
    np.testing.assert_array_equal(AS_IS.augment(picture, np.random.default_rng(0)), picture)


def test_labels_lie_on_what_they_name_in_turned_mirrored_and_distant_crops(labelled):
    settings = KeypointCrops(
        crops=24, hidden=0, smaller=0.5, astray=0, elsewhere=0, turned=1, looks=AS_IS
    )
    batch = keypoint_batch([(labelled, 0)], PictureCache(), settings, np.random.default_rng(0))
    sides = set()
    for crop, keypoints in zip(batch.crops.astype(int), batch.keypoints, strict=True):
        red = crop[..., 0] - crop[..., 2]
        mirrored = _mirrored(keypoints)
        sides.add(mirrored)
        # In a mirror the left ear is a right one: the red dot then is labelled the right ear.
        is_red, is_blue = (RIGHT_EAR, LEFT_EAR) if mirrored else (LEFT_EAR, RIGHT_EAR)
        for joint, level in ((is_red, red), (is_blue, -red)):
            rows, columns = np.nonzero(level > 0.6 * level.max())
            middle = np.array([columns.mean(), rows.mean()])
            # A dot of 10 px seen in coarse pixels has its middle within half of one.
            assert np.linalg.norm(middle - keypoints[joint]) < 1.3
    assert sides == {True, False}


def _mirrored(keypoints):
    """Whether a crop is mirrored, by what is labelled left and right.

    As it is, the left ear is 40 px right of the right one and 30 px higher. In a mirror the blue
    dot is labelled left: 40 px right of the red one, 30 px lower. No turn comes to 37 degrees.
    """
    return bool(keypoints[LEFT_EAR, 1] > keypoints[RIGHT_EAR, 1])


def test_who_is_partly_outside_of_a_window_is_asked_for_by_the_part_inside(labelled):
    # The window shows x from 200 on and y from 100 on, in pixels of half the size.
    mapping = np.array([[2.0, 0.0, 200.0], [0.0, 2.0, 100.0]])
    wanted, ignored = boxes_in_window(labelled, (300, 400, 3), mapping, 64)
    np.testing.assert_allclose(wanted, [[-0.5, -0.5, 20.0, 55.0]])
    assert len(ignored) == 0
    # Only a sixth is left of him beyond x = 230.
    mapping[0, 2] = 230.0
    wanted, ignored = boxes_in_window(labelled, (300, 400, 3), mapping, 64)
    assert len(wanted) == 0 and len(ignored) == 1


def test_the_target_is_one_at_the_cell_of_the_middle():
    target, weight = np.zeros((16, 16), np.float32), np.ones((16, 16), np.float32)
    sides = np.zeros((4, 16, 16), np.float32)
    box = np.array([[10.0, 6.0, 20.0, 38.0]])
    draw_targets(box, np.array([[40.0, 40.0, 64.0, 64.0]]), target, weight, sides)
    # Cell (row 5, column 3) has its middle at x 13.5, y 21.5; the box's is at 15, 22.
    assert np.argwhere(target == 1.0).tolist() == [[5, 3]]
    assert sides[:, 5, 3].tolist() == box[0].tolist()
    assert weight[10:, 10:].sum() == 0 and weight[:9].all()


def test_shared_area_is_that_of_the_detection_stage_and_falls_with_distance():
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 40, (2, 30, 2))
    a, b = (np.concatenate([each, each + rng.uniform(5, 40, (30, 2))], axis=1) for each in corners)
    share, general = box_overlap(torch.from_numpy(a)[:, None], torch.from_numpy(b))
    # Areas are 25 px^2 and more, to which a millionth is added.
    np.testing.assert_allclose(share, box_iou(a, b), atol=1e-6)
    # Nested boxes fill their hull: the two are equal but for rounding.
    assert torch.all(general <= share + 1e-9) and torch.all(general >= -1.0)
    # Two boxes of 10 x 10 px side by side, 10 px apart: none shared, a third of the hull empty.
    pair = torch.tensor([[0.0, 0.0, 10.0, 10.0], [20.0, 0.0, 30.0, 10.0]])
    torch.testing.assert_close(box_overlap(pair[0], pair[1])[1], torch.tensor(-1.0 / 3.0))


def test_the_box_is_learned_in_upright_crops_and_nothing_else_beside_people(labelled):
    people, cache = labelled_people([labelled]), PictureCache()
    for elsewhere in (0, 1):
        crops = KeypointCrops(crops=8, elsewhere=elsewhere, turned=0, smaller=0, looks=AS_IS)
        batch = keypoint_batch(people, cache, crops, np.random.default_rng(3))
        assert np.isfinite(batch.people[:, 0]).all() and np.isnan(batch.people[:, 1:]).all()
        # The person of 60 x 120 px keeps his shape, in a mirror too.
        sides = batch.people[:, 0, 2:] - batch.people[:, 0, :2]
        np.testing.assert_allclose(sides[:, 1] / sides[:, 0], 2.0, rtol=1e-5)
        if elsewhere:
            assert np.isnan(batch.boxes).all() and not batch.visible.any()
        else:
            np.testing.assert_array_equal(batch.boxes, batch.people[:, 0])
    turned = keypoint_batch(
        people, cache, KeypointCrops(crops=8, turned=1, looks=AS_IS), np.random.default_rng(3)
    )
    assert np.isnan(turned.boxes).all() and np.isnan(turned.people).all()


def test_a_few_steps_on_one_batch_lower_both_losses(labelled):
    torch.manual_seed(0)
    rng, cache = np.random.default_rng(1), PictureCache()
    people = people_batch([labelled], cache, PeopleWindows(windows=2, side=64, looks=AS_IS), rng)
    crops = KeypointCrops(crops=4, elsewhere=0, turned=0, looks=AS_IS)
    persons = labelled_people([labelled])
    assert [index for _, index in persons] == [0]
    keypoints = keypoint_batch(persons, cache, crops, rng)
    assert keypoints.crops.shape[1:] == (CROP[1], CROP[0], 3)
    for net, loss, batch in (
        (PeopleNet(), people_loss, people),
        (KeypointNet(), keypoint_loss, keypoints),
    ):
        optimizer = torch.optim.AdamW(net.parameters(), lr=2e-3)
        losses = []
        for _ in range(4):
            value = loss(net, batch)
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            losses.append(float(value.detach()))
        assert losses[-1] < 0.95 * losses[0]
