import numpy as np

from worldpose.evaluation.matching import box_overlaps, joint_boxes
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

DOWN_Z = Camera(
    focal=np.array([100.0, 100.0]),
    principal_point=np.array([50.0, 50.0]),
    distortion=np.zeros(5),
    cam_from_world=Rigid.identity(),
    image_size=np.array([100, 100]),
)


def overlap(a, b):
    return box_overlaps(np.array([[a]], dtype=float), np.array([[b]], dtype=float))[0, 0, 0]


def test_overlap_of_boxes():
    assert overlap([0, 0, 2, 2], [0, 0, 2, 2]) == 1.0
    # One of 4 + 4 - 1.
    assert overlap([0, 0, 2, 2], [1, 1, 3, 3]) == 1 / 7
    assert overlap([0, 0, 2, 2], [2, 0, 4, 2]) == 0.0
    assert overlap([0, 0, 2, 2], [5, 5, 6, 6]) == 0.0
    assert overlap([1, 1, 1, 1], [1, 1, 1, 1]) == 0.0


def test_missing_boxes_have_no_overlap():
    assert np.isnan(overlap([np.nan] * 4, [0, 0, 2, 2]))
    assert box_overlaps(np.zeros((3, 0, 4)), np.zeros((3, 2, 4))).shape == (3, 2, 0)


def test_boxes_go_around_the_joints_in_front_of_the_camera():
    joints = np.array(
        [[[[1.0, 2.0, 10.0], [-1.0, 0.0, 10.0], [0.0, 0.0, -5.0]], [[np.nan] * 3] * 3]]
    )
    boxes = joint_boxes(joints, DOWN_Z)
    assert boxes[0, 0].tolist() == [40.0, 50.0, 60.0, 70.0]
    assert np.isnan(boxes[0, 1]).all()


def test_a_camera_for_every_frame():
    joints = np.array([[[[0.0, 0.0, 10.0], [1.0, 1.0, 10.0]]]] * 2)
    zoom = Camera(
        focal=np.array([[100.0, 100.0], [200.0, 200.0]]),
        principal_point=DOWN_Z.principal_point,
        distortion=DOWN_Z.distortion,
        cam_from_world=DOWN_Z.cam_from_world,
        image_size=DOWN_Z.image_size,
    )
    assert joint_boxes(joints, zoom)[:, 0].tolist() == [[50.0, 50, 60, 60], [50.0, 50, 70, 70]]
