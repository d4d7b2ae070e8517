"""The nets that ship with the project: what they find, in which form, and in which views."""

import numpy as np
import pytest
import torch
from camera_builders import look_at_camera
from numpy.lib.stride_tricks import sliding_window_view
from numpy.testing import assert_allclose
from pydantic import ValidationError
from safetensors.torch import save

from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import (
    FORMAT,
    KeypointNet,
    PeopleNet,
    decode_boxes,
    decode_candidates,
    load_weights,
    save_weights,
)
from worldpose.detection.bundled_pose import (
    BundledPoseEstimator,
    CropEstimates,
    assign_joints,
    find_occluded_people,
)
from worldpose.detection.enlargement import expect_parts, find_small
from worldpose.detection.interfaces import People
from worldpose.detection.models import (
    BUNDLED_WEIGHTS,
    LANDMARK_WEIGHTS,
    load_bundled_detector,
    load_bundled_pose,
)
from worldpose.detection.net_inference import QuantizedNet, run_together
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError
from worldpose.geometry.boxes import box_iou
from worldpose.ingest.registration import digest_of_files
from worldpose.pitch.template import PitchTemplate


def shaken(net):
    """The net with normalisations that are not trivial."""
    torch.manual_seed(1)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0.0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    return net.eval()


def test_people_and_poses_do_not_depend_on_the_batch():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (90, 130, 3), dtype=np.uint8)
    # The second has no neighbour: the pose is the same whatever other boxes are given.
    boxes = np.array(
        [[85.0, 5.0, 110.0, 80.0], [-8.0, 20.0, 40.0, 120.0], [90.0, 1.0, 112.0, 60.0]]
    )
    pose = BundledPoseEstimator(shaken(KeypointNet()))
    together, alone = pose.estimate(picture, boxes), pose.estimate(picture, boxes[1:2])
    np.testing.assert_array_equal(together.keypoints[1:2], alone.keypoints)
    np.testing.assert_array_equal(together.confidence[1:2], alone.confidence)
    np.testing.assert_array_equal(together.boxes[1:2], alone.boxes)
    np.testing.assert_array_equal(together.score[1:2], alone.score)
    assert np.all((together.score > 0) & (together.score < 1))
    assert np.all((together.confidence > 0) & (together.confidence <= 1))
    nobody = pose.estimate(picture, np.empty((0, 4)))
    assert nobody.keypoints.shape == (0, 17, 2) and nobody.confidence.shape == (0, 17)
    net = shaken(PeopleNet())
    with torch.no_grad():
        net.head[-1].bias[0] = 0.0
    both = BundledDetector(net).detect([picture, picture[::-1].copy()])
    assert len(both[0].boxes) > 0
    inside = (both[0].boxes >= -0.5) & (both[0].boxes <= np.array([130, 90, 130, 90]) - 0.5)
    assert inside.all()


class Elsewhere(torch.Tensor):
    """A tensor that is decoded as on a GPU, by torch alone."""

    is_cpu = False


def test_torch_alone_takes_the_first_of_equal_cells_as_the_kernel():
    maps = torch.zeros(1, 1, 32, 24)
    both = [decode_candidates(maps.as_subclass(kind), 4) for kind in (torch.Tensor, Elsewhere)]
    for kernel, alone in zip(*both, strict=True):
        np.testing.assert_allclose(kernel.numpy(), alone.numpy(), rtol=1e-6)


def test_torch_alone_finds_the_boxes_of_the_kernel():
    rng = np.random.default_rng(6)
    given = []
    for shape in ((2, 9, 14), (1, 5, 3)):
        logits, sides = rng.normal(0.0, 3.0, shape), rng.uniform(1.0, 40.0, (4, *shape))
        given.append([torch.from_numpy(each).float() for each in (logits, sides.swapaxes(0, 1))])
    kernel, alone = (
        decode_boxes([[one.as_subclass(kind) for one in each] for each in given], 0.3).numpy()
        for kind in (torch.Tensor, Elsewhere)
    )
    assert set(kernel[:, 0]) == {0.0, 1.0, 2.0} and len(kernel) > 15
    np.testing.assert_allclose(kernel, alone, rtol=1e-12)
    best = given[0][0][1].argmax().item()  # of the second image
    (row,) = kernel[(kernel[:, 0] == 1.0) & (kernel[:, 5] == kernel[kernel[:, 0] == 1.0, 5].max())]
    left, top, right, bottom = given[0][1][1].flatten(1)[:, best].tolist()
    x, y = (4.0 * at + 1.5 for at in (best % 14, best // 14))
    np.testing.assert_allclose(row[1:5], [x - left, y - top, x + right, y + bottom], rtol=1e-6)


@pytest.mark.parametrize("kind", [torch.Tensor, Elsewhere])
def test_joints_are_the_peaks_that_a_search_over_all_cells_finds(kind):
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:32, :24]
    at = rng.uniform([0, 0], [32, 24], (2, 17, 3, 2))[..., None, None]
    heights = rng.uniform(4.0, 9.0, (2, 17, 3, 1, 1))
    waves = heights * np.exp(-((y - at[..., 0, :, :]) ** 2 + (x - at[..., 1, :, :]) ** 2) / 8.0)
    maps = torch.from_numpy(waves.sum(axis=2) + rng.normal(0.0, 0.1, (2, 17, 32, 24))).float()
    places, mass = (each.numpy() for each in decode_candidates(maps.as_subclass(kind), 4))
    chance = torch.softmax(maps.flatten(2), dim=-1).view_as(maps).numpy()
    wide = np.pad(chance, ((0, 0), (0, 0), (3, 3), (3, 3)))
    peak = chance == sliding_window_view(wide, (7, 7), axis=(2, 3)).max(axis=(4, 5))
    about = sliding_window_view(wide[..., 1:-1, 1:-1], (5, 5), axis=(2, 3))
    total = about.sum(axis=(4, 5))
    for one in np.ndindex(2, 17):
        row, column = np.nonzero(peak[one] & (total[one] >= 0.02))
        order = np.argsort(-total[one][row, column])[:4]
        row, column, near = row[order], column[order], about[one][row[order], column[order]]
        share = near / near.sum(axis=(1, 2), keepdims=True)
        right = column + (share * np.arange(-2, 3)).sum(axis=(1, 2))
        below = row + (share * np.arange(-2, 3)[:, None]).sum(axis=(1, 2))
        count = int((mass[one] >= 0.02).sum())
        assert 1 <= count == len(order)
        np.testing.assert_allclose(mass[one][:count], total[one][row, column], rtol=1e-5)
        said = 2.0 * np.stack([right, below], axis=1) + 0.5
        np.testing.assert_allclose(places[one][:count], said, atol=1e-3)


@pytest.mark.parametrize("weights", [*BUNDLED_WEIGHTS, LANDMARK_WEIGHTS], ids=lambda p: p.stem)
def test_nets_in_integers_are_of_the_shipped_weights(weights):
    net = QuantizedNet(weights.with_suffix(".onnx"))
    assert net.weights_sha256 == digest_of_files(weights)


def test_nets_in_integers_see_what_they_see_in_floating_point(still):
    exact = load_bundled_detector(BUNDLED_WEIGHTS[0]).detect([still])[0]
    found = load_bundled_detector().detect([still])[0]
    sure = [people.boxes[people.scores >= 0.4] for people in (exact, found)]
    assert len(sure[0]) == len(sure[1]) >= 4
    overlap = box_iou(*sure)
    assert overlap.max(axis=1).min() > 0.9 and overlap.max(axis=0).min() > 0.9
    estimators = map(load_bundled_pose, (BUNDLED_WEIGHTS[1], None))
    poses = [each.estimate(still, sure[0]) for each in estimators]
    known = poses[0].confidence > 0.5
    moved = np.linalg.norm(poses[1].keypoints - poses[0].keypoints, axis=-1)[known]
    tall = sure[0][:, 3] - sure[0][:, 1]
    assert known.sum() > 30 and np.median(moved) < 0.005 * np.median(tall)
    assert np.abs(poses[1].confidence - poses[0].confidence)[known].mean() < 0.03


def test_weights_come_back_and_give_equal_bytes(tmp_path):
    net, file = shaken(PeopleNet()), tmp_path / "people.safetensors"
    about = {name: name for name in "fedcba"}
    save_weights(file, net, about)
    first = file.read_bytes()
    save_weights(file, load_weights(file, PeopleNet()), about)
    assert file.read_bytes() == first


@pytest.mark.parametrize(
    "change",
    [
        lambda bias: {"head.1.bias": bias * float("nan")},
        lambda bias: {"head.1.bias": bias[:-1].contiguous()},
        lambda bias: {"more": torch.zeros(1)},
    ],
    ids=["poisoned", "cut off", "a stranger"],
)
def test_weights_with_other_content_are_refused(tmp_path, change):
    file, tensors = tmp_path / "people.safetensors", PeopleNet().state_dict()
    tensors = {name: value.contiguous() for name, value in tensors.items()}
    file.write_bytes(save(tensors | change(tensors["head.1.bias"]), {FORMAT: "PeopleNet"}))
    with pytest.raises(InputError, match=r"people\.safetensors"):
        load_weights(file, PeopleNet())


def test_files_that_are_no_weights_are_refused_and_run_nothing(tmp_path):
    file, trap = tmp_path / "people.safetensors", tmp_path / "sprung"

    class Trap:
        def __reduce__(self):
            return open, (str(trap), "w")

    for write, told in (
        (lambda: None, "no file"),
        (lambda: torch.save({"net": Trap()}, file), "cannot be read"),
        (lambda: file.write_bytes(b""), "cannot be read"),
        (lambda: save_weights(file, KeypointNet()), "weights of KeypointNet"),
        (lambda: file.write_bytes(save(PeopleNet().state_dict())), "weights of something else"),
    ):
        write()
        with pytest.raises(InputError, match=told):
            load_weights(file, PeopleNet())
    assert not trap.exists()


SHAPE = (1080, 1920, 3)


def people(*boxes, score=0.9):
    return People(np.array(boxes, dtype=float).reshape(-1, 4), np.full(len(boxes), score))


def test_small_people_are_seen_in_enlarged_tiles_and_tall_ones_are_not():
    small = [(x, 500.0, x + 10.0, 520.0) for x in np.arange(100.0, 1900.0, 100.0)]
    step = (36.0, 2.0)
    tiles = find_small(people(*small), SHAPE, step)
    assert len(tiles) == 4  # 1782 px and a margin on both sides, enlarged, in tiles of 1024 px
    for box in small:
        # Each person's centre lies in one tile, whose crop shows the person whole.
        (tile,) = [t for t in tiles if len(t.merge(people(), seen(t, box)).scores)]
        assert np.all(np.array(tile.corner) < box[:2]) and np.all(np.array(tile.end) > box[2:])
        np.testing.assert_allclose(tile.to_frame(seen(tile, box)).boxes, [box], atol=1e-9)
    tall = [(x, 400.0, x + 20.0, 440.0) for x in np.arange(100.0, 1900.0, 50.0)]
    assert find_small(people(*small, *tall), SHAPE, step) == []
    # If no box is sure, all boxes give the size.
    assert find_small(people(*small, score=0.1), SHAPE, step)
    assert find_small(people(), SHAPE, step) == []


def seen(part, *boxes):
    """Boxes of the frame as found in the crop of a part."""
    shift = np.tile(np.array(part.corner), 2)
    return people(*((np.array(boxes) - shift + 0.5) * part.zoom - 0.5))


def looking(focal):
    return look_at_camera((0.0, -75.0, 22.0), (0.0, 5.0, 0.0), focal)


def test_a_calibrated_camera_tells_where_people_are_small():
    pitch = PitchTemplate.standard()
    assert {part.zoom for part in expect_parts(looking(3200.0), pitch, 2.5)} == {0.5}  # 136 px
    assert {part.zoom for part in expect_parts(looking(12000.0), pitch, 2.5)} == {0.5, 0.25}
    assert {tile.zoom for tile in expect_parts(looking(1000.0), pitch, 2.5)} == {2.0, 3.0}
    camera = looking(1250.0)
    tiles = expect_parts(camera, pitch, 2.5)
    assert {tile.zoom for tile in tiles} == {2.0}
    for y, wanted in ((33.0, True), (-33.0, False)):  # 20 and 48 px
        (feet, head) = camera.project(np.array([[5.0, y, 0.0], [5.0, y, 1.8]]))
        middle = 0.5 * (feet + head)
        box = np.array([middle[0] - 4, head[1], middle[0] + 4, feet[1]])
        found = any(len(tile.to_frame(seen(tile, box)).scores) for tile in tiles)
        assert found == wanted


FRONT = np.array([100.0, 50.0, 140.0, 150.0])
HIDDEN = FRONT + [18.0, -6.0, 18.0, -6.0]
FAR = FRONT + [300.0, 0.0, 300.0, 0.0]


class Told:
    """Finds the present person nearest to the box, except those given as neighbours.

    If all are given as neighbours, it finds one of them.
    """

    def __init__(self, *there, fit=0.9):
        self.there, self.fit, self.asked = np.array(there).reshape(-1, 4), fit, []

    def __call__(self, _, asked):
        if not asked:
            return []
        ((boxes, others),) = asked
        self.asked.append(boxes)
        shares = box_iou(boxes, self.there)
        for row, known in zip(shares, others, strict=True):
            row[(box_iou(self.there, known) > 0.7).any(axis=1)] *= 1e-3
        seen = self.there[shares.argmax(axis=1)] if len(self.there) else np.full_like(boxes, np.nan)
        across = np.linspace(0.0, 1.0, 17)[:, None]
        joints = seen[:, None, :2] + (seen[:, 2:] - seen[:, :2])[:, None] * across
        places = np.repeat(joints[:, :, None], 4, axis=2) + np.arange(4.0)[:, None]
        flat = np.full((len(boxes), 17, 4), 0.8)
        return [CropEstimates(places, flat, flat, seen, np.full(len(boxes), self.fit))]


def test_who_is_hidden_by_half_is_found_once_with_his_own_box_and_pose():
    look = Told(FRONT, HIDDEN, FAR)
    (found,) = run_together([find_occluded_people(people(FRONT, FAR, score=0.8))], look)
    assert_allclose(found.boxes, [HIDDEN])
    assert_allclose(found.score, [np.cbrt(0.3 * 0.9 * 0.8)])
    assert_allclose(found.keypoints[0, [0, 16]].ravel(), HIDDEN)
    # A step of 0.35 widths to either side of both; then about the one who was seen.
    assert_allclose(look.asked[0][:, 0], [86.0, 386.0, 114.0, 414.0])
    assert_allclose(look.asked[1], [HIDDEN] * len(look.asked[1]))


@pytest.mark.parametrize("boxes", [(FRONT, FAR), (FRONT, HIDDEN, FAR), ()])
def test_where_all_are_known_nobody_is_found(boxes):
    (others,) = run_together([find_occluded_people(people(*boxes, score=0.8))], Told(*boxes))
    assert (others.boxes.shape, others.score.shape) == ((0, 4), (0,))
    assert others.keypoints.shape == (0, 17, 2)
    assert others.confidence.shape == (0, 17)


@pytest.mark.parametrize("pose", ["onnx:net.onnx", "transformers:net"])
def test_another_pose_net_does_not_search_for_occluded_people(pose):
    with pytest.raises(ValidationError, match="find_occluded needs the bundled pose net"):
        DetectionSettings(find_occluded=True, pose=pose)
    assert DetectionSettings(find_occluded=True, pose="embedded:net.safetensors").find_occluded


def test_a_joint_is_not_put_where_a_neighbour_has_that_of_the_other_side():
    places, mass = np.zeros((2, 17, 2, 2)), np.zeros((2, 17, 2))
    # Joints of their own, far from all others, but for one's left ankle and the other's right.
    places[..., 0, 1] = np.arange(34).reshape(2, 17) * 100.0
    mass[..., 0] = 1.0
    left, right = 15, 16
    places[0, left, 0] = places[1, right, 0] = [5.0, -100.0]
    places[1, right, 1], mass[1, right] = [20.0, -100.0], [0.5, 0.4]
    taken = assign_joints(
        places, mass, np.array([[0.0, 0.0, 40.0, 100.0], [20.0, 0.0, 60.0, 100.0]])
    )
    assert np.argwhere(taken).tolist() == [[1, right]]
