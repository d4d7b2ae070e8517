"""Marker files that the test writes, laid over a prediction whose place and time are known."""

import numpy as np
import pytest
from people_samples import person
from scipy.spatial.transform import Rotation

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.evaluation.marker_reference import (
    align_reference,
    map_marker_names,
    marker_joints,
    read_marker_map,
    read_markers,
)
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.motion_capture import write_markers

FPS, RATE, OFFSET = 50.0, 100.0, 0.7313
TURN = Rotation.from_rotvec([0.0, 0.0, 2.1])
SHIFT = np.array([30.0, -12.0, 0.4])


def people_at(times):
    """Two people who run on curves, at times [s] (times, 2, 17, 3) [m]."""
    ways = np.stack(
        [
            [3.0 * np.sin(1.3 * times), 2.0 * np.cos(0.9 * times)],
            [-4.0 + 1.5 * times, 3.0 * np.sin(0.7 * times + 1.0)],
        ]
    )
    places = np.zeros((len(times), 2, 1, 3))
    places[..., 0, :2] = ways.transpose(2, 0, 1)
    return person() + places


def in_lab(joints):
    """World points in the motion capture system's own world."""
    return TURN.inv().apply((joints - SHIFT).reshape(-1, 3)).reshape(joints.shape)


@pytest.fixture
def markers():
    return in_lab(people_at(np.arange(600) / RATE - OFFSET))


@pytest.fixture
def prediction():
    frames = np.arange(10, 160)
    return JointTracks(frames, np.array([4, 9]), people_at(frames / FPS)[:, ::-1])


def write_c3d(path, joints, missing=()):
    c3d = pytest.importorskip("c3d")
    writer = c3d.Writer(point_rate=RATE)
    writer.set_point_labels([f"{who}:{name}" for who in ("Ada", "Bob") for name in COCO17])
    rows = np.zeros((len(joints), 34, 5), np.float32)
    rows[..., :3] = 1000.0 * joints.reshape(len(joints), 34, 3)
    for sample, marker in missing:
        rows[sample, marker, 3] = -1.0
    writer.add_frames([(row, np.zeros((0, 0))) for row in rows])
    with path.open("wb") as file:
        writer.write(file)


def test_c3d_gives_the_points_that_were_written(tmp_path, markers):
    write_c3d(tmp_path / "a.c3d", markers, missing=[(3, 5)])
    found = read_markers(tmp_path / "a.c3d")
    assert (found.rate, len(found.names)) == (RATE, 34)
    joints = marker_joints(found, map_marker_names(found.names))
    assert np.isnan(joints[3, 0, 5]).all()
    joints[3, 0, 5] = markers[3, 0, 5]
    # Single precision millimetres at 40 m.
    np.testing.assert_allclose(joints, markers, atol=1e-5)


def test_a_c3d_file_whose_analog_scale_is_one_number_is_read(tmp_path, markers):
    """So ezc3d writes files with no or one analog channel."""
    ezc3d = pytest.importorskip("ezc3d")
    content = ezc3d.c3d()
    content["parameters"]["POINT"]["RATE"]["value"] = [RATE]
    content["parameters"]["POINT"]["LABELS"]["value"] = ["left_hip", "right_hip"]
    content["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    points = np.ones((4, 2, len(markers)))
    points[:3] = markers[:, 0, 11:13].transpose(2, 1, 0)
    content["data"]["points"] = points
    content.write(str(tmp_path / "a.c3d"))
    whole = (tmp_path / "a.c3d").read_bytes()
    empty = b"\x05\x02SCALE\x06\0\x04\x01\0\0"  # offset 6, float, one dimension of length 0
    single = b"\x05\x02SCALE\x09\0\x04\0\0\0\x80\xbf\0"  # offset 9, float, no dimension, -1
    assert empty in whole
    end = 512 * (int.from_bytes(whole[16:18], "little") - 1)  # of the parameters
    (tmp_path / "a.c3d").write_bytes(whole[:end].replace(empty, single)[:end] + whole[end:])
    found = read_markers(tmp_path / "a.c3d")
    np.testing.assert_allclose(found.points, markers[:, 0, 11:13], atol=1e-5)


@pytest.mark.parametrize("numbers", [(5, 6, 9), (0, 4, 16), ("", "", "")])
def test_rows_of_trc_are_at_their_frames_and_zeros_are_missing(tmp_path, numbers):
    text = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tUnits", "100\tm"]
    text += ["Frame#\tTime\tA\t\t\tB\t\t", "\t\tX1\tY1\tZ1", ""]
    for number, time, x in zip(numbers, (0.0, 0.01, 0.04), (1, 0, 2), strict=True):
        text += [f"{number}\t{time}\t{x}\t0\t0.0\t1\t2\t3"]
    (tmp_path / "a.trc").write_text("\n".join(text) + "\n")
    found = read_markers(tmp_path / "a.trc")
    np.testing.assert_array_equal(found.points[:, 0, 0], [1.0, *[np.nan] * 3, 2.0])
    np.testing.assert_array_equal(found.points[:, 1, 0], [1.0, 1.0, np.nan, np.nan, 1.0])
    assert found.zeros == 1
    (tmp_path / "a.trc").write_text("\n".join([*text[:6], text[7], text[6].replace("0.0", "")]))
    with pytest.raises(InputError, match="that rise"):
        read_markers(tmp_path / "a.trc")
    (tmp_path / "a.trc").write_text("\n".join(text[:6]) + "\n")
    with pytest.raises(InputError, match="samples of markers, found none"):
        read_markers(tmp_path / "a.trc")


def test_joints_are_means_of_markers_as_the_map_says(tmp_path):
    file = tmp_path / "map.yaml"
    file.write_text("Ada: {left_hip: [A, B], nose: C}\n")
    people = read_marker_map(file)
    text = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tUnits", "100\tcm"]
    text += ["Frame#\tTime\tA\t\t\tB\t\t\tC\t\t", "\t\tX1\tY1\tZ1", ""]
    text += ["1\t0\t100\t0\t0\t300\t0\t0\t\t\t"]
    (tmp_path / "a.trc").write_text("\n".join(text) + "\n")
    joints = marker_joints(read_markers(tmp_path / "a.trc"), people)
    assert joints[0, 0, COCO17.index("left_hip")].tolist() == [2.0, 0.0, 0.0]
    assert np.isnan(joints[0, 0, 0]).all()
    file.write_text("Ada: {elbow: A}\n")
    with pytest.raises(InputError, match="found elbow"):
        read_marker_map(file)
    with pytest.raises(InputError, match="the marker D"):
        marker_joints(read_markers(tmp_path / "a.trc"), {"Ada": {"nose": ("D",)}})


def test_time_place_and_people_are_found_again(tmp_path, markers, prediction):
    reference, found = align_reference(prediction, markers, RATE, FPS)
    # Straight between samples of a curve: 2 m/s^2 for 5 ms leaves micrometres.
    assert found.offset == pytest.approx(OFFSET, abs=2e-4)
    np.testing.assert_allclose(found.motion.rotation, TURN.as_matrix(), atol=1e-3)
    np.testing.assert_allclose(found.motion.translation, SHIFT, atol=2e-3)
    assert float(found.motion.scale) == 1.0
    assert found.residual < 1e-3
    scores, _ = evaluate_joints(prediction, reference)
    assert scores.mpjpe_mm == pytest.approx(0.0, abs=1.0)
    assert scores.coverage == 1.0


def test_a_clip_that_starts_late_is_found_by_the_times_of_the_file_or_its_first_sample(
    tmp_path, markers, prediction
):
    late = JointTracks(prediction.frames + 500, prediction.person_ids, prediction.joints)
    cases = ((late, 10.0, OFFSET), (prediction, 10.0, OFFSET + 10.0), (late, 0.0, OFFSET - 10.0))
    for mine, start, offset in cases:
        _, found = align_reference(mine, markers, RATE, FPS, start)
        assert found.offset == pytest.approx(offset, abs=2e-4) and found.residual < 1e-3
    write_markers(tmp_path / "late.trc", late, 0, FPS)
    assert read_markers(tmp_path / "late.trc").start == pytest.approx(late.frames[0] / FPS)


def test_known_error_stays(markers, prediction):
    # Everybody's left wrist 5 cm off, one joint of 17: no rigid motion of all takes much of it.
    joints = prediction.joints.copy()
    joints[:, :, 9, 2] += 0.05
    wrong = JointTracks(prediction.frames, prediction.person_ids, joints)
    reference, _ = align_reference(wrong, markers, RATE, FPS)
    scores, _ = evaluate_joints(wrong, reference)
    # A shift of all people by 1/17 of it takes the mean from the others: (48 + ...) / 17 of 50.
    assert scores.mpjpe_mm == pytest.approx((16 / 17 * 50 + 16 * 50 / 17) / 17, rel=0.1)


@pytest.mark.parametrize("name", ["a.c3d", "a.trc"])
def test_damaged_files_are_named(tmp_path, name):
    pytest.importorskip("c3d")
    (tmp_path / name).write_bytes(b"nothing at all\n" * 3)
    with pytest.raises(InputError, match=f"{name}: expected a complete C3D or TRC file"):
        read_markers(tmp_path / name)
    with pytest.raises(InputError, match="found nothing"):
        read_markers(tmp_path / "none" / name)
