"""Files as programs name them, people without points, and tables in archives."""

import gzip
import io
import json
import zipfile

import av
import cv2
import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.evaluation.position_reference import read_positions
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.coco_results import BATCH, read_coco_results
from worldpose.formats.detection_files import read_openpose_folder
from worldpose.ingest.camera_videos import describe_unused, find_videos
from worldpose.ingest.clicks import import_clicks
from worldpose.ingest.importing import camera_of, import_match, import_videos
from worldpose.ingest.match_folder import read_match
from worldpose.parsing import read_cells
from worldpose.video.files import VideoReader, holds_video
from worldpose.video.folder import numbered_images, open_video
from worldpose.video.names import frame_numbers

SIZE = (48, 64)
POINTS = [value for n in range(17) for value in (100.0 + n, 200.0 + 2 * n, 0.5)]


def level(number, size=SIZE):
    return np.full((*size, 3), 10 + 16 * number, np.uint8)


def number_of(picture):
    return round((float(picture.mean()) - 10) / 16)


def test_images_are_in_the_order_of_the_numbers_in_their_names(tmp_path):
    for number in (7, 9, 12):
        cv2.imwrite(str(tmp_path / f"img ({number}).png"), level(number))
    with open_video(tmp_path) as video:
        assert [number_of(shown) for _, shown in video.frames()] == [7, 9, 12]
        assert video.index.on_clock(25.0, "images").tolist() == [0, -1, 1, -1, -1, 2]


@pytest.mark.parametrize(
    "form",
    ["frame ({}).jpg", "frame%20{}.png", "upload/9a1b2c3d-f{}.png", "d=x%2Fa_{}.png", "{}_cam1"],
)
def test_key_frames_have_the_numbers_in_their_names(tmp_path, form):
    (tmp_path / "match.yaml").write_text(
        "match_id: m\nfps: 25.0\ncameras:\n- {id: main, width: 64, height: 48, kind: broadcast}\n"
        "clips:\n- {id: goal, first_frame: 0, frame_count: 50, broadcast: main}\n"
    )
    point = '<points label="halfway_far" points="30.5,20.5"/>'
    shown = "".join(
        f'<image name="{form.format(n)}" width="64" height="48">{point}</image>' for n in (12, 7)
    )
    (tmp_path / "c.xml").write_text(f"<annotations>{shown}</annotations>")
    import_clicks(tmp_path / "c.xml", tmp_path, "goal")
    content = json.loads((tmp_path / "annotations/broadcast_calibration/goal.json").read_text())
    assert [each["frame"] for each in content["key_frames"]] == [7, 12]


@pytest.mark.parametrize(
    "names",
    [
        {"half1_000084": 84, "half2_000310": 310},
        {"00-15-30_22950": 22950, "00-16-10_23950": 23950},
        {"00001_frame000005": 5, "00002_frame000010": 10, "00003_frame000015": 15},
    ],
)
def test_the_last_number_counts_where_it_can_be_a_frame(tmp_path, names):
    for name in names:
        cv2.imwrite(str(tmp_path / f"{name}.png"), level(1))
    found = {file.stem: number for number, file in numbered_images(tmp_path)}
    assert found == frame_numbers(names, ends=True) == names


def test_poses_and_videos_are_of_cameras_with_hyphens_or_capitals(tmp_path, make_camera):
    folders = map(tmp_path.joinpath, ("cam.1_json", "GX010001.MP4_json"))
    assert [*map(camera_of, folders)] == ["cam.1", "GX010001"]
    names = ["cam_2", "cam_1"]  # not in the order of their numbers
    cameras = {name: make_camera(name, 0.1 * n + 0.1) for n, name in enumerate(names)}
    write_calibration_toml(tmp_path / "calibration.toml", cameras)
    (tmp_path / "poses").mkdir()
    for n in (1, 2):
        person = [{"image_id": n, "keypoints": POINTS}]
        (tmp_path / "poses" / f"CAM-{n}.json").write_text(json.dumps(person))
    import_match(tmp_path / "calibration.toml", tmp_path / "poses", 25.0, tmp_path / "m")
    given = read_match(tmp_path / "m").detections
    assert {*given} == {*names}
    seen = {n: np.isfinite(np.load(file)["score"]).any(axis=1) for n, file in given.items()}
    assert {n: each.tolist() for n, each in seen.items()} == {
        "cam_1": [True, False],
        "cam_2": [False, True],
    }
    (tmp_path / "poses" / "cam_1.json").write_text("[]")
    with pytest.raises(InputError, match=r"one file of cam_1, found CAM-1\.json and cam_1\.json"):
        import_match(tmp_path / "calibration.toml", tmp_path / "poses", 25.0, tmp_path / "n")


def boxed(frame, **more):
    return {"image_id": frame, "category_id": 1, "bbox": [10, 20, 30, 40], "score": 0.7, **more}


@pytest.mark.parametrize("nothing", [{"keypoints": None}, {"keypoints": []}, {}])
def test_a_person_with_a_box_alone_stays_one_and_a_ball_is_none(tmp_path, nothing):
    people = [boxed(3, keypoints=POINTS), boxed(4, **nothing)]
    ball = {**boxed(5, **nothing), "category_id": 37}
    unnamed, flat = {**boxed(5, **nothing)}, boxed(6, **nothing, iscrowd=1)
    del unnamed["category_id"]
    (tmp_path / "a.json").write_text(json.dumps([*people, ball]))
    (tmp_path / "d.json").write_text(json.dumps([*people, unnamed]))
    (tmp_path / "e.json").write_text(json.dumps([*people, flat]))
    category = {"id": 1, "name": "person", "keypoints": list(COCO17)}
    crowd = boxed(6, keypoints=[0] * 51, iscrowd=1)
    content = {"annotations": [*people, ball], "categories": [category, {"id": 37, "name": "ball"}]}
    (tmp_path / "c.json").write_text(json.dumps(content | {"annotations": [*people, crowd]}))
    (tmp_path / "b.json").write_text(json.dumps(content))
    for file in ("a.json", "b.json", "c.json", "d.json", "e.json"):
        found = read_coco_results(tmp_path / file)
        assert found.people.frame.tolist() == [3, 4]
        np.testing.assert_array_equal(found.people.boxes[1, 0], [10, 20, 40, 60])
        assert found.people.score[1, 0] == np.float32(0.7)
        assert np.isnan(found.people.confidence[1]).all()
        assert (found.changes.nobody, found.changes.pointless) == (0, 1)


@pytest.mark.parametrize("before", [0, 1, BATCH - 1, BATCH, 2 * BATCH + 1])
def test_entries_without_points_mean_the_same_wherever_they_are(tmp_path, before):
    empty = [{"image_id": n, "keypoints": []} for n in range(before)]
    full = [{"image_id": before, "keypoints": [*POINTS, *POINTS[:27]]}]  # of 26 points
    for rows in (empty + full, full + empty):
        (tmp_path / "a.json").write_text(json.dumps(rows))
        found = read_coco_results(tmp_path / "a.json")
        assert found.people.frame.tolist() == [before]
        assert found.changes.pointless == before
    (tmp_path / "a.json").write_text(json.dumps(empty or [{"image_id": 0, "bbox": [1] * 4}]))
    with pytest.raises(InputError, match=f"found {max(before, 1)} entries without keypoints"):
        read_coco_results(tmp_path / "a.json")
    (tmp_path / "a.json").write_text(json.dumps([*full, {"image_id": 0}]))
    with pytest.raises(InputError, match="result 1, keypoints: expected 78 numbers"):
        read_coco_results(tmp_path / "a.json")


def test_annotations_of_easymocap_are_read(tmp_path):
    points = np.reshape([*POINTS, *POINTS[:24]], (25, 3)).tolist()
    people = [{"personID": 3, "bbox": [400.0, 250.0, 600.0, 800.0, 0.9], "keypoints": points}]
    content = {"filename": "images/a/000004.jpg", "annots": people, "isKeyframe": False}
    (tmp_path / "000004.json").write_text(json.dumps(content))
    found = read_openpose_folder(tmp_path, "body_25b")
    assert found.people.frame.tolist() == [4]
    np.testing.assert_array_equal(found.people.keypoints[0, 0, 3], [103, 206])


def test_a_copy_of_a_frame_is_refused_and_is_no_other_frame(tmp_path):
    for name in ("a_000012.json", "a_000012 (1).json", "a_000013.json"):
        (tmp_path / name).write_text('{"people": []}')
    with pytest.raises(InputError, match=r"one file per frame, found a_000012( \(1\))?\.json with"):
        read_openpose_folder(tmp_path)
    assert frame_numbers(["a_3.png", "a_3 copy 2.png", "a_4 2.png"])["a_3 copy 2.png"] == 3


@pytest.mark.parametrize("empty", [[], None])
@pytest.mark.parametrize(
    ("filled", "other"),
    [
        ("keypoints", "pose_keypoints_2d"),
        ("pose_keypoints_2d", "keypoints"),
        ("joints", "keypoints"),
    ],
)
def test_the_filled_one_of_two_lists_of_points_counts(tmp_path, empty, filled, other):
    people = [{other: empty, filled: POINTS}, {other: empty, filled: [], "keypoint_scores": []}]
    (tmp_path / "a_000004.json").write_text(json.dumps({"people": people}))
    found = read_openpose_folder(tmp_path)
    assert (found.people.score.shape, found.changes.nobody) == ((1, 1), 1)
    np.testing.assert_array_equal(found.people.keypoints[0, 0, 3], [103, 206])


def table(times):
    rows = [f"{n};{time};a;{n % 3},5;20,25" for n, time in enumerate(times)]
    return "\n".join(["frame_id;timestamp;player_id;x;y", *rows])


@pytest.mark.parametrize(
    "form",
    ["00:00:{:06.3f}", "0 days 00:00:{:06.3f}", "00:{:06.3f}", "2024-05-01T12:00:{:06.3f}+02:00"],
)
@pytest.mark.parametrize("sign", [".", ","])
def test_times_of_positions_may_have_a_decimal_comma(tmp_path, form, sign):
    times = [form.format(n / 12.5).replace(".", sign) for n in range(40)]
    (tmp_path / "a.csv").write_text(table(times))
    numbers, names, places, rate = read_positions(tmp_path / "a.csv")
    assert (len(numbers), names, rate) == (40, ("a",), pytest.approx(12.5, rel=1e-6))
    np.testing.assert_array_equal(places[:3, 0], [[0.5, 20.25], [1.5, 20.25], [2.5, 20.25]])


def test_times_that_are_none_are_refused(tmp_path):
    (tmp_path / "b.csv").write_text(table(f"{40 * n}ms" for n in range(5)))
    assert read_positions(tmp_path / "b.csv")[3] == pytest.approx(25.0)
    (tmp_path / "a.csv").write_text(table(["half past"] * 3))
    with pytest.raises(InputError, match="the time 'half past', neither"):
        read_positions(tmp_path / "a.csv")


def archive(**files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        for name, text in files.items():
            file.writestr(name, text)
    return content.getvalue()


def test_positions_may_be_in_an_archive(tmp_path):
    text = table([f"00:00:0{n / 25}" for n in range(9)])
    (tmp_path / "a.csv").write_text(text)
    wanted = read_positions(tmp_path / "a.csv")[2]
    packed = [
        archive(**{"x/a.csv": text, "__MACOSX/x/._a.csv": "\0"}),
        gzip.compress(text.encode()),
    ]
    for content in packed:
        (tmp_path / "a.zip").write_bytes(content)
        np.testing.assert_array_equal(read_positions(tmp_path / "a.zip")[2], wanted)
    (tmp_path / "a.zip").write_bytes(gzip.compress(b"a,b\n" * 9999))
    with pytest.raises(InputError, match="more than 999 bytes"):
        read_cells(tmp_path / "a.zip", 999, "")
    (tmp_path / "a.csv").write_text("PKEY,b\n1,2\n")
    assert read_cells(tmp_path / "a.csv", 999, "")[0][0][1] == ["PKEY", "b"]
    for content, said in (
        (archive(**{"a.csv": text, "b.csv": text}), "2 files, a.csv, b.csv: give one"),
        (archive(**{"[Content_Types].xml": "", "xl/a.xml": ""}), "a workbook, not text"),
        (packed[0][:-30], "a damaged or locked archive"),
        (packed[1][:-9], "a damaged or locked archive"),
    ):
        (tmp_path / "a.zip").write_bytes(content)
        with pytest.raises(InputError, match=said):
            read_positions(tmp_path / "a.zip")


CONTAINERS = {
    "mod": ("vob", "mpeg2video", "yuv420p"),
    "": ("matroska", "mpeg4", "yuv420p"),
    "recording": ("mp4", "mpeg4", "yuv420p"),
}


def encode(path, form, codec, pixels, size=SIZE):
    with av.open(str(path), "w", format=form) as container:
        stream = container.add_stream(codec, 25)
        stream.height, stream.width, stream.pix_fmt = *size, pixels
        for number in range(12):
            frame = av.VideoFrame.from_ndarray(level(number, size), format="rgb24")
            container.mux(stream.encode(frame.reformat(format=pixels)))
        container.mux(stream.encode(None))


@pytest.mark.parametrize("ending", CONTAINERS)
def test_a_video_may_have_any_container_that_is_decoded(tmp_path, ending):
    (tmp_path / "videos").mkdir()
    for camera in ("a", "b"):
        encode(tmp_path / "videos" / f"{camera}.{ending}".rstrip("."), *CONTAINERS[ending])
    (tmp_path / "videos" / "notes.txt").write_text("the second half " * 999)
    (tmp_path / "videos" / "a.THM").write_bytes(cv2.imencode(".jpg", level(3))[1].tobytes())
    spec, notes = import_videos(None, tmp_path / "videos", tmp_path / "m", fps=25.0)
    assert [each.id for each in spec.cameras] == ["a", "b"]
    assert "a.THM, notes.txt" in str(notes)
    for file in read_match(tmp_path / "m").videos.values():
        with VideoReader(file) as video:
            assert [number_of(shown) for _, shown in video.frames()] == list(range(12))
            assert number_of(video.frame(7)) == 7


def test_content_tells_a_video_only_where_no_name_does(tmp_path):
    """GoPro writes a small copy beside each video."""
    for name in ("GX010017.MP4", "GL010017.LRV"):
        encode(tmp_path / name, "mp4", "mpeg4", "yuv420p")
    assert [*find_videos(tmp_path)] == ["GX010017"]
    assert "GL010017.LRV" in str(describe_unused(tmp_path, ()))


def test_pictures_and_lists_are_no_videos_and_a_link_to_nothing_is_told(tmp_path):
    encode(tmp_path / "preview.gif", "gif", "gif", "rgb8")
    (tmp_path / "live.m3u8").write_text("#EXTM3U\n#EXTINF:6,\nhttp://127.0.0.1:9/a.ts\n")
    assert not any(map(holds_video, tmp_path.iterdir()))
    encode(tmp_path / "a.mp4", "mp4", "mpeg4", "yuv420p")
    (tmp_path / "b.mp4").symlink_to(tmp_path / "unmounted.mp4")
    assert [file.stem for file in find_videos(tmp_path).values()] == ["a", "b"]


def test_frames_of_a_program_stream_are_found_by_number_where_a_packet_has_several(tmp_path):
    encode(tmp_path / "a.mpg", "mpeg", "mpeg1video", "yuv420p", (144, 192))
    with VideoReader(tmp_path / "a.mpg") as video:
        assert [number_of(video.frame(n)) for n in (11, 7, 6, 2, 7)] == [11, 7, 6, 2, 7]


def test_lost_frames_of_an_avi_do_not_lower_its_rate(tmp_path):
    with av.open(str(tmp_path / "a.avi"), "w") as container:
        stream = container.add_stream("mjpeg", 25)
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuvj420p"
        for number in (0, 1, 2, 4, 5, 6, 7, 9, 10, 11):
            frame = av.VideoFrame.from_ndarray(level(number), format="rgb24")
            frame.pts = number
            container.mux(stream.encode(frame.reformat(format="yuvj420p")))
        container.mux(stream.encode(None))
    with VideoReader(tmp_path / "a.avi") as video:
        assert video.index.fps == 25.0
        assert np.flatnonzero(video.index.on_clock(25.0, "a.avi") < 0).tolist() == [3, 8]
