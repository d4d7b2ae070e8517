import numpy as np
import pytest
import torch
from safetensors.torch import save

from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import (
    CROP,
    FORMAT,
    KeypointNet,
    PeopleNet,
    decode_boxes,
    edges,
    load_weights,
    peaks,
    save_weights,
)
from worldpose.detection.bundled_pose import (
    BundledPoseEstimator,
    crops_around,
    cut_crop,
    frame_from_crop,
)
from worldpose.detection.models import (
    BUNDLED_WEIGHTS,
    load_bundled_detector,
    load_bundled_pose,
)
from worldpose.detection.net_inference import QuantizedNet
from worldpose.errors import InputError
from worldpose.geometry.boxes import box_iou
from worldpose.ingest.registration import digest_of_files
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.training.labels import read_picture


def shaken(net):
    """The net with normalisations that are not trivial."""
    torch.manual_seed(1)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0.0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    return net.eval()


def test_a_crop_shows_its_box_and_goes_back_to_the_picture():
    picture = np.zeros((200, 300, 3), dtype=np.uint8)
    picture[50:150, 100:140] = 255
    box = np.array([[99.5, 49.5, 139.5, 149.5]])
    for turn, mirrored in ((0.0, False), (0.3, True)):
        mapping = frame_from_crop(crops_around(box)[0], CROP, turn, mirrored)
        crop = cut_crop(picture, mapping, CROP, outside=0)
        rows, columns = np.nonzero(crop[..., 0] > 127)
        middle = np.array([columns.mean(), rows.mean()])
        np.testing.assert_allclose(middle, (np.array(CROP) - 1) / 2, atol=0.05)
        np.testing.assert_allclose(mapping[:, :2] @ middle + mapping[:, 2], [119.5, 99.5], atol=0.1)
        # The box fills the crop but for its margin: its height is the tighter side.
        area = np.abs(np.linalg.det(mapping[:, :2]))
        # Its outline of 280 px is known to a quarter of a pixel.
        assert len(rows) * area == pytest.approx(40 * 100, abs=140)
        assert np.sqrt(area) == pytest.approx(1.25 * 100 / CROP[1])


def test_the_peak_of_a_bump_is_found_within_a_cell():
    y, x = np.mgrid[:64, :48]
    said = np.array([20.3, 41.6])
    bump = -0.5 * (((x - said[0]) / 0.8) ** 2 + ((y - said[1]) / 0.8) ** 2)
    at, mass = peaks(torch.tensor(bump, dtype=torch.float32)[None, None])
    # Cells are 2 px, the first one's middle is at 0.5; five cells lose a little of one tail.
    np.testing.assert_allclose(at[0, 0], 2 * said + 0.5, atol=0.05)
    assert float(mass) > 0.97


def test_edges_are_read_along_their_own_axis():
    rows, columns = 32, 24
    maps = torch.full((1, 4, rows, columns), -40.0)
    # The left edge in column 3 of some rows, the right one between columns 20 and 21 of one row.
    maps[0, 0, 5:9, 3] = maps[0, 2, 30, 20] = maps[0, 2, 30, 21] = 0.0
    maps[0, 1, 2, :] = maps[0, 3, 28, 7] = 0.0
    boxes, spread = edges(maps)
    # Cells of 4 px whose first middle is at 1.5.
    torch.testing.assert_close(boxes, torch.tensor([[13.5, 9.5, 83.5, 113.5]]))
    torch.testing.assert_close(spread, torch.tensor([[1e-3, 1e-3, 0.5, 1e-3]]), atol=1e-3, rtol=0)


def test_boxes_stand_at_peaks_best_first():
    logits, sides = torch.full((8, 10), -9.0), torch.full((4, 8, 10), 5.0)
    logits[2, 3], logits[2, 4], logits[6, 8] = 1.0, 0.5, 2.0
    boxes, scores = decode_boxes(logits, sides, 0.05, 300)
    # Cells of 4 px whose first middle is at 1.5; the neighbour of a better cell is no peak.
    np.testing.assert_allclose(boxes, [[28.5, 20.5, 38.5, 30.5], [8.5, 4.5, 18.5, 14.5]])
    np.testing.assert_allclose(scores, torch.sigmoid(torch.tensor([2.0, 1.0])))
    assert len(decode_boxes(logits, sides, 0.05, 1)[0]) == 1


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


@pytest.mark.parametrize("which", [0, 1])
def test_nets_in_integers_are_of_the_shipped_weights(which):
    net = QuantizedNet(BUNDLED_WEIGHTS[which].with_suffix(".onnx"))
    assert net.weights_sha256 == digest_of_files(BUNDLED_WEIGHTS[which])


def test_nets_in_integers_see_what_they_see_in_floating_point(tmp_path):
    options = MatchOptions(duration=0.04, cameras=2, video=False)
    simulate_match(SCENARIOS["tiny"], 5, tmp_path / "tiny", options)
    image = read_picture(sorted((tmp_path / "tiny" / "stills").iterdir())[0])
    exact = load_bundled_detector(BUNDLED_WEIGHTS[0]).detect([image])[0]
    found = load_bundled_detector().detect([image])[0]
    sure = [people.boxes[people.scores >= 0.4] for people in (exact, found)]
    assert len(sure[0]) == len(sure[1]) >= 4
    overlap = box_iou(*sure)
    assert overlap.max(axis=1).min() > 0.9 and overlap.max(axis=0).min() > 0.9
    poses = [
        load_bundled_pose(weights).estimate(image, sure[0])
        for weights in (BUNDLED_WEIGHTS[1], None)
    ]
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


def _tensors(net, change):
    tensors = {name: value.contiguous() for name, value in net.state_dict().items()}
    change(tensors)
    return tensors


def _poison(tensors):
    tensors["head.1.bias"] = tensors["head.1.bias"] * float("nan")


def _cut_off(tensors):
    tensors["head.1.bias"] = tensors["head.1.bias"][:-1].contiguous()


def _stranger(tensors):
    tensors["more"] = torch.zeros(1)


@pytest.mark.parametrize("change", [_poison, _cut_off, _stranger])
def test_weights_with_other_content_are_refused(tmp_path, change):
    file = tmp_path / "people.safetensors"
    file.write_bytes(save(_tensors(PeopleNet(), change), {FORMAT: "PeopleNet"}))
    with pytest.raises(InputError, match=r"people\.safetensors"):
        load_weights(file, PeopleNet())


def test_files_that_are_no_weights_are_refused_and_run_nothing(tmp_path):
    file, trap = tmp_path / "people.safetensors", tmp_path / "sprung"

    class Trap:
        def __reduce__(self):
            return open, (str(trap), "w")

    torch.save({"net": Trap()}, file)
    with pytest.raises(InputError, match="cannot be read"):
        load_weights(file, PeopleNet())
    assert not trap.exists()
    file.write_bytes(b"")
    with pytest.raises(InputError, match="cannot be read"):
        load_weights(file, PeopleNet())
    with pytest.raises(InputError, match="no file"):
        load_weights(tmp_path / "none.safetensors", PeopleNet())
    save_weights(file, KeypointNet())
    with pytest.raises(InputError, match="weights of KeypointNet"):
        load_weights(file, PeopleNet())
    file.write_bytes(save(PeopleNet().state_dict()))  # of another program
    with pytest.raises(InputError, match="weights of something else"):
        load_weights(file, PeopleNet())
