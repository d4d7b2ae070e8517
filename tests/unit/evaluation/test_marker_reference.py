"""Markers and places of others as references: read, laid over, and scored."""

import json

import numpy as np
import pytest
from command_line import invoke
from people_samples import person
from scipy.spatial.transform import Rotation

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.evaluation.challenge import ALL, score_submission
from worldpose.evaluation.marker_reference import (
    align_reference,
    map_marker_names,
    marker_joints,
    read_marker_map,
    read_markers,
)
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.evaluation.position_reference import align_positions, read_positions
from worldpose.formats.challenge import write_submission
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


@pytest.mark.parametrize("case", ["one analog scale", "zero bytes and many units"])
def test_c3d_files_of_other_programs_are_read_and_a_cut_one_refused(tmp_path, markers, case):
    """ezc3d writes files with no or one analog channel with a scale of one number."""
    ezc3d, path = pytest.importorskip("ezc3d"), tmp_path / "a.c3d"
    content, points = ezc3d.c3d(), np.ones((4, 2, len(markers)))
    points[:3] = markers[:, 0, 11:13].transpose(2, 1, 0)
    units = ["m"] if case == "one analog scale" else ["m", "m"]
    about = {"RATE": [RATE], "LABELS": ["left_hip", "right_hip"], "UNITS": units}
    for name, value in about.items():
        content["parameters"]["POINT"][name]["value"] = value
    content["data"]["points"] = points
    content.write(str(path))
    whole = path.read_bytes()
    end = 512 * (int.from_bytes(whole[16:18], "little") - 1)  # of the parameters
    if case == "one analog scale":
        empty = b"\x05\x02SCALE\x06\0\x04\x01\0\0"  # offset 6, float, one dimension of length 0
        single = b"\x05\x02SCALE\x09\0\x04\0\0\0\x80\xbf\0"  # offset 9, float, no dimension, -1
    else:
        empty, single = b"left_hip ", b"left_hip\0"
    assert empty in whole
    path.write_bytes(whole[:end].replace(empty, single)[:end] + whole[end:])
    found = read_markers(path)
    assert found.names == ("left_hip", "right_hip")
    np.testing.assert_allclose(found.points, markers[:, 0, 11:13], atol=1e-5)
    path.write_bytes(path.read_bytes()[:-9000])
    with pytest.raises(InputError, match=r"expected 600 frames.*: it was cut off"):
        read_markers(path)


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
    commas = "\n".join(line.replace(".", ",") for line in [*text[:2], "100.0\tm", *text[3:]])
    (tmp_path / "a.trc").write_text(commas + "\n")
    np.testing.assert_array_equal(read_markers(tmp_path / "a.trc").points, found.points)
    (tmp_path / "a.trc").write_text("\n".join(text).replace("\t3", "\t3,000") + "\n")  # thousands
    with pytest.raises(InputError, match="found could not convert string to float: '3,000'"):
        read_markers(tmp_path / "a.trc")
    (tmp_path / "a.trc").write_text("\n".join([*text[:6], text[7], text[6].replace("0.0", "")]))
    with pytest.raises(InputError, match="that rise"):
        read_markers(tmp_path / "a.trc")
    (tmp_path / "a.trc").write_text("\n".join(text[:6]) + "\n")
    with pytest.raises(InputError, match="samples of markers, found none"):
        read_markers(tmp_path / "a.trc")


def test_markers_without_a_name_or_of_one_name_move_no_others(tmp_path):
    text = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tNumFrames\tUnits", "100\t2\tmeter"]
    text += ["Frame#\tTime\tA\t\t\t\t\t\tB \t\t\tnose\t\t\tnose\t\t\t", "\t\tX1\tY1\tZ1", ""]
    text += [f"{n}\t{n / 100}\t" + "\t".join(map(str, range(1, 16))) for n in (1, 2)]
    file = tmp_path / "a.trc"
    for encoding in ("utf-8", "utf-16"):
        file.write_text("\n".join(text) + "\n", encoding)
        found = read_markers(file)
        joints = marker_joints(found, {"Ada": {"left_hip": ("A",), "right_hip": ("B",)}})
        np.testing.assert_array_equal(joints[0, 0, 11:13], [[1, 2, 3], [7, 8, 9]])
    with pytest.raises(InputError, match="expected the marker nose, found 2 of it"):
        marker_joints(found, map_marker_names(found.names))
    file.write_text("\n".join(text)[:-9])
    with pytest.raises(InputError, match="expected 17 columns in the last row, found 14: it was"):
        read_markers(file)


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
    assert found.residual < 1e-3 and found.is_sure
    # A clock off by 4 s, beyond the search; and a moment, which any offset explains but for noise.
    noisy = prediction.joints[:3, 1:] + np.random.default_rng(0).normal(0.0, 0.02, (3, 1, 17, 3))
    brief = JointTracks(np.arange(10, 13), np.array([4]), noisy)
    for mine, part in ((prediction, markers[400:]), (brief, markers[:, :1])):
        assert not align_reference(mine, part, RATE, FPS)[1].is_sure
    scores, _ = evaluate_joints(prediction, reference)
    assert (scores.mpjpe_mm, scores.coverage) == (pytest.approx(0.0, abs=1.0), 1.0)


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


NAMES = ("home_11", "away_4", "home_7")


def tracks():
    """Three people who walk apart; their hips are 0.9 m high."""
    frames = np.arange(100, 130)
    start = np.array([[-20.0, 8.0], [3.0, -5.0], [30.0, 12.0]])
    way = np.array([[0.1, 0.0], [0.0, 0.2], [-0.1, 0.1]])
    places = start + (frames - 100)[:, None, None] * way
    joints = np.full((30, 3, 17, 3), np.nan)
    joints[:, :, [11, 12], :2] = places[:, :, None] + [[-0.15, 0.0], [0.15, 0.0]]
    joints[:, :, [11, 12], 2] = 0.9
    return JointTracks(frames, np.array([4, 5, 9]), joints), places


def wide(places, first=0):
    lines = ["period_id,frame_id,ball_x,ball_y," + ",".join(f"{n}_x,{n}_y,{n}_s" for n in NAMES)]
    for n, row in enumerate(places.tolist()):
        lines.append(f"1,{first + n},0,0," + ",".join(f"{x:.3f},{y:.3f},1.5" for x, y in row))
    return "\n".join(lines)


def long(places, first=0):
    lines = ["frame_id,player_id,x,y"]
    for n, row in enumerate(places.tolist()):
        people = [("ball", (0.0, 0.0)), *zip(NAMES, row, strict=True)]
        lines += [f"{first + n},{name},{x:.3f},{y:.3f}" for name, (x, y) in people]
    return "\n".join(lines)


@pytest.mark.parametrize("form", [wide, long])
@pytest.mark.parametrize("way", [(1, 1), (-1, -1), (1, -1)])
def test_places_of_every_form_and_way_name_the_people(tmp_path, form, way):
    mine, places = tracks()
    file = tmp_path / "positions.csv"
    file.write_text(form((places + [0.0, 0.1]) * way, first=7000))
    predicted, given, notes = align_positions(file, mine, 100)
    assert notes[-1] == "people: {4: home_11, 5: away_4, 9: home_7}"
    assert len(notes) == 1 + (way != (1, 1))
    scores, _ = evaluate_joints(predicted, given, fps=25.0)
    assert scores.mpjpe_mm == pytest.approx(100.0)
    assert (scores.coverage, scores.switches, scores.persons) == (1.0, 0, 3)
    text = file.read_text().replace(",", ";").replace(".", ",")
    for saved in (text.encode("utf-16"), text.replace("home_7", "home_7\xfc").encode("cp1252")):
        file.write_bytes(saved)
        np.testing.assert_array_equal(align_positions(file, mine, 100)[1].joints, given.joints)


def test_people_of_one_name_are_told_apart_and_pieces_of_a_track_are_not(tmp_path):
    people = [(0, 7, "Ann"), (0, 9, "Ann"), (0, 4, "Eve"), (1, 7, "Ann"), (1, 12, "Eve")]
    lines = [f"{frame},{who},{name},{who},2" for frame, who, name in people]
    (tmp_path / "a.csv").write_text("\n".join(["frame_id,player_id,name,x,y", *lines]))
    _, names, places, _ = read_positions(tmp_path / "a.csv")
    assert names == ("Ann 7", "Ann 9", "Eve")
    np.testing.assert_array_equal(places[..., 0], [[7.0, 9.0, 4.0], [7.0, np.nan, 12.0]])


@pytest.mark.parametrize("timed", [True, False])
def test_places_at_another_rate_are_at_their_times(tmp_path, timed):
    mine, places = tracks()
    mine = JointTracks(mine.frames - 100, mine.person_ids, mine.joints)
    lines = wide(places[::2], first=0).splitlines()
    if timed:
        times = [f",0 days 00:00:{n / 12.5:09.6f}" for n in range(len(lines) - 1)]
        lines = [line + more for line, more in zip(lines, [",timestamp", *times], strict=True)]
    (tmp_path / "positions.csv").write_text("\n".join(lines))
    predicted, given, notes = align_positions(tmp_path / "positions.csv", mine, fps=25.0)
    assert "each frame of the positions is 2 frames of the match" in notes[0]
    scores, _ = evaluate_joints(predicted, given, fps=25.0)
    assert scores.mpjpe_mm == pytest.approx(0.0, abs=1.0)
    assert given.frames.tolist() == list(range(29))


@pytest.mark.parametrize(
    ("numbers", "seconds", "periods", "rate"),
    [
        ([5, 6, 7, 900, 901], [0.1, 0.2, 0.3, 0.7, 0.8], ["1", "1", "1", "2", "2"], 10.0),
        ([7000, 7100, 7200], [0.0, 0.1, 0.2], ["1", "1", "1"], 1000.0),
        ([7, 8, 9], [0.0, 0.0001, 0.0002], ["1", "1", "1"], np.nan),
        ([7, 8, 9], [0.0, 3.0, 6.0], ["1", "1", "1"], np.nan),
    ],
    ids=["periods", "milliseconds", "too short", "too long"],
)
def test_the_rate_is_that_within_periods_in_any_unit_of_frames(
    tmp_path, numbers, seconds, periods, rate
):
    rows = zip(periods, seconds, numbers, strict=True)
    lines = [f"{period},0 days 00:00:0{time:.6f},{n},3,4" for period, time, n in rows]
    (tmp_path / "a.csv").write_text("\n".join(["period_id,timestamp,frame_id,p_x,p_y", *lines]))
    assert read_positions(tmp_path / "a.csv")[3] == pytest.approx(rate, nan_ok=True)


@pytest.mark.parametrize(
    ("fps", "rate", "said"),
    [(60.0, 29.97, None), (25.0, 29.97, None), (59.94, 29.97, None), (59.94, 29.97, 30.0)],
)
def test_rows_of_a_television_rate_are_at_their_frames_also_by_nominal_times(
    tmp_path, fps, rate, said
):
    """Each row as one of 30 a second would be off by up to 0.3 m."""

    def walk(frames):
        return 20.0 * np.sin(frames / 200.0)[:, None]

    mine, _ = tracks()
    joints = np.tile(mine.joints[:1], (3401, 1, 1, 1))
    hips = joints[:1, :, 11:13, :2].mean(axis=2)
    joints[..., 0] += walk(np.arange(3401))[..., None]
    mine = JointTracks(np.arange(3401), mine.person_ids, joints)
    rows = np.arange(int(3400 * rate / fps))
    lines = wide(hips + walk(rows * fps / rate)[..., None] * [1.0, 0.0]).splitlines()
    if said:
        times = ["timestamp", *(f"{row / said:.3f}" for row in rows)]
        lines = [",".join(pair) for pair in zip(lines, times, strict=True)]
    (tmp_path / "positions.csv").write_text("\n".join(lines))
    predicted, given, notes = align_positions(tmp_path / "positions.csv", mine, fps=fps)
    assert notes[0].endswith("by agreement alone") and "warning" not in str(notes)
    assert evaluate_joints(predicted, given, fps=fps)[0].mpjpe_mm < 2.0


def test_people_who_hardly_move_do_not_tell_the_rate_of_places_without_times(tmp_path):
    mine, places = tracks()
    mine = JointTracks(mine.frames - 100, mine.person_ids, np.tile(mine.joints[:1], (30, 1, 1, 1)))
    (tmp_path / "positions.csv").write_text(wide(np.tile(places[:1], (30, 1, 1)), first=0))
    _, given, notes = align_positions(tmp_path / "positions.csv", mine, fps=25.0)
    assert "have no times, and people move too little to tell their rate" in notes[0]
    assert given.frames.tolist() == list(range(30))


@pytest.mark.parametrize(
    "form",
    ["{:.1f}", "00:00:{:02.0f}", "{:.0f}", "{:.5f}"],
    ids=["tenths", "clock", "s", "minutes"],
)
def test_coarse_clocks_leave_each_row_at_its_frame(tmp_path, form):
    mine, _ = tracks()
    joints = np.tile(mine.joints[:1], (90, 1, 1, 1))
    joints[..., 0] += 0.1 * np.arange(90)[:, None, None]
    mine = JointTracks(np.arange(90), mine.person_ids, joints)
    lines = wide(joints[:, :, 11:13, :2].mean(axis=2)).splitlines()
    times = [
        form.format(n // 5 / 5 if "1f" in form else n / 1500 if "5f" in form else n // 25)
        for n in range(90)
    ]
    lines = [",".join(pair) for pair in zip(lines, ["time_s", *times], strict=True)]
    (tmp_path / "positions.csv").write_text("\n".join(lines))
    _, given, notes = align_positions(tmp_path / "positions.csv", mine, fps=25.0)
    assert (given.frames.tolist(), len(notes)) == (list(range(90)), 1)
    both = [f"{line},{time}" for line, time in zip(lines, ["timestamp", *times], strict=True)]
    (tmp_path / "positions.csv").write_text("\n".join(both))
    assert len(read_positions(tmp_path / "positions.csv")[0]) == 90


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda places: places / [105.0, 68.0] + 0.5, "metres from the centre spot"),
        (lambda places: 100.0 * places, "metres from the centre spot"),
        (lambda places: places + [5.0, 0.0], "people of the match, one way round"),
    ],
)
def test_places_in_other_units_or_of_others_are_refused(tmp_path, change, words):
    mine, places = tracks()
    file = tmp_path / "positions.csv"
    file.write_text(wide(change(places), first=100))
    with pytest.raises(InputError, match=words):
        align_positions(file, mine)


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,2\n", "frame_id,p_x\n1,2\n", "frame,p_x,p_y\n1,a,2\n"]
)
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "positions.csv").write_text(text)
    with pytest.raises(InputError, match="to_df"):
        read_positions(tmp_path / "positions.csv")


def submission(path, **clips):
    write_submission(path, clips)
    return path


def poses(persons=2, frames=3):
    return np.random.default_rng(0).normal(size=(persons, frames, 15, 3))


@pytest.mark.parametrize(
    ("joint", "whole", "local"),
    # A toe of 15 joints; a hip, which moves the mid-hip by half of it and with it every joint.
    [(14, 0.15 / 15, 0.15 / 15), (7, 0.15 / 15, 0.075), (slice(None), 0.15, 0.0)],
)
def test_the_score_is_the_global_error_and_five_times_the_local_one(tmp_path, joint, whole, local):
    true, found = poses(), poses()
    found[:, :, joint, 0] += 0.15
    truth = submission(tmp_path / "true.zip", one=true)
    mine = submission(tmp_path / "mine.zip", one=found)
    score = score_submission(mine, truth)["one"]
    np.testing.assert_allclose((score.global_m, score.local_m), (whole, local), atol=1e-6)
    assert score.poses == 6
    told = invoke("evaluate", "--prediction", mine, "--reference", truth, "--json")
    assert json.loads(told.stdout)["challenge_score"] == pytest.approx(whole + 5 * local, abs=1e-5)


def test_clips_count_by_their_joints_and_absent_people_do_not_count(tmp_path):
    true = {"a": poses(1, 1), "b": poses(1, 3)}
    found = submission(tmp_path / "p.zip", a=true["a"], b=true["b"] + [0.4, 0.0, 0.0])
    true["b"][0, 2] = np.nan
    score = score_submission(found, submission(tmp_path / "t.zip", **true))[ALL]
    assert (score.poses, score.global_m) == (3, pytest.approx(2 * 0.4 / 3, abs=1e-6))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda p: {"one": p[:1]}, "persons, frames, 15, 3"),
        (lambda p: {"two": p}, "no such clip"),
        (lambda p: {"one": np.where(np.arange(3)[:, None, None] == 1, np.nan, p)}, "frame 1"),
    ],
)
def test_a_missing_clip_person_or_pose_is_refused(tmp_path, change, told):
    truth = submission(tmp_path / "t.zip", one=poses())
    with pytest.raises(InputError, match=told):
        score_submission(submission(tmp_path / "p.zip", **change(poses())), truth)


def test_a_table_without_its_last_empty_rows_is_scored_and_a_lacking_pose_is_refused(tmp_path):
    pytest.importorskip("pyarrow")
    true, found = poses(), poses() + [0.1, 0.0, 0.0]
    true[1], true[:, 2] = np.nan, np.nan
    truth = submission(tmp_path / "true.parquet", one=true)
    score = score_submission(submission(tmp_path / "mine.zip", one=found), truth)["one"]
    assert (score.global_m, score.poses) == (pytest.approx(0.1), 2)
    short = submission(tmp_path / "short.parquet", one=found[:, :1])
    with pytest.raises(InputError, match=r"1 without one|15 without one"):
        score_submission(short, truth)
