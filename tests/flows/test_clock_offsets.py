"""Commands that find clock offsets, cameras and lenses, and write them on request."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import page_client
import pytest
import yaml
from command_line import invoke, succeed
from run_records import calibration, match_spec

from data_contracts.cameras import LensCalibration
from flows.cli.calibrate import _cameras
from flows.cli.locate import _lens, _print_offsets
from flows.results.clock_offsets import ClockOffsets, Proposal, propose
from flows.run_record import latest_run
from flows.service.inbox import run_key, take_in, watch_once
from flows.service.layout import served_state
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.lens_files import read_lens_toml, write_lens_toml
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import align
from worldpose.store.store import Store
from worldpose.triangulation.synchronization import Synchronization
from worldpose.video.files import write_video


@pytest.fixture(scope="module")
def shifted(tiny, tmp_path_factory):
    """The match `tiny` with given cameras, of which one has a wrong clock offset."""
    folder = shift(tiny, tmp_path_factory.mktemp("shifted") / "tiny")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    return folder


def shift(tiny, folder):
    shutil.copytree(tiny, folder)
    file = folder / "match.yaml"
    content = yaml.safe_load(file.read_text())
    content["cameras"][2]["offset_frames"] = 5
    file.write_text(yaml.safe_dump(content))
    return folder


def test_an_offset_is_found_drawn_and_written(server, shifted, tmp_path):
    asked, plot = ("synchronize", shifted, "--project", tmp_path / "p"), tmp_path / "clocks.svg"
    found = succeed(*asked, "--plot", plot, "--json").json
    rows = {row["camera"]: row for row in found["cameras"]}
    assert {name: row["proposed"] for name, row in rows.items()} == dict.fromkeys(rows, 0)
    assert rows["cam02"]["stated"] == 5
    assert abs(rows["cam02"]["found"]) < 0.2
    assert found["applied"] == {}
    assert "<svg" in plot.read_text()
    assert succeed(*asked, "--apply", "--json").json["applied"] == {"cam02": 0}
    cameras = yaml.safe_load((shifted / "match.yaml").read_text())["cameras"]
    assert [camera.get("offset_frames", 0) for camera in cameras] == [0] * len(cameras)


def test_an_offset_that_nothing_tells_is_not_called_right(capsys):
    rows = [Proposal(name, 4, 4.0, 0.5, 4, "", "left") for name in ("mid", "left")]
    rows.append(Proposal("right", 0, None, None, 0, "?"))
    for shown, told in ((rows, True), (rows[1:], False)):
        _print_offsets(ClockOffsets("clip", ["left", "right"], None, shown), None, applied=False)
        said = capsys.readouterr().out
        assert ("The people confirm the offsets of mid, relative to left." in said) == told
        assert "Nothing tells the offsets of right: they stay, right or wrong." in said
        assert "no change" not in said


@pytest.mark.slow
def test_the_page_shows_the_same_proposal_and_applies_it_in_the_next_version(
    server, tiny, tmp_path, monkeypatch
):
    project, inbox = tmp_path / "p", tmp_path / "p" / "inbox"
    folder = shift(tiny, tmp_path / "m")
    succeed("run", folder, "--until", "detection", "--project", project)
    store, before = Store.open(str(project)), (folder / "match.yaml").read_bytes()
    inbox.mkdir()
    ada = page_client.log_in(page_client.served(project), "Ada")
    offsets = f"{page_client.MATCH}/offsets"
    found = ada.get(offsets).json()
    assert found["changed"] == {"cam02": 0}
    row = next(each for each in found["cameras"] if each["camera"] == "cam02")
    assert (row["stated"], row["proposed"]) == (5, 0) and abs(row["found"]) < 0.2
    assert ada.get(f"{offsets}/plot").content.startswith(b"\x89PNG")
    with monkeypatch.context() as patch:  # a unit that failed changed nothing
        record = latest_run(store, page_client.TINY)
        rest = {unit: key for unit, key in record.results.items() if unit != "detection/cam05"}
        part = record.model_copy(update={"results": rest})
        patch.setattr("flows.web.offsets.latest_run", lambda *_: part)
        assert ada.get(offsets).status_code == 200
    assert ada.post(offsets, json={"offsets": {"cam02": 1}}).status_code == 422  # not the proposal
    assert ada.post(offsets, json={"offsets": found["changed"]}).status_code == 200
    (coming,) = ada.get(page_client.MATCH).json()["next_versions"]
    assert coming["state"] == "arriving"
    state = served_state(store.url)
    watch_once(state, inbox, 0.0)
    (arrival,) = take_in(store, state, inbox, 0.0, run_key)
    # The same videos are no reason to take an earlier run for that of this version.
    registration = store.registration(page_client.TINY)
    assert arrival.flow_run != f"arrival-{registration.identity}"
    static = [each for each in registration.spec.cameras if each.kind == "static"]
    assert [each.offset_frames for each in static] == [0] * 6
    assert (folder / "match.yaml").read_bytes() == before
    answer = ada.get(offsets)  # nobody corrects twice by the run of the old offsets
    assert answer.status_code == 422 and "Run it again first" in answer.json()["error"]


@pytest.mark.parametrize(
    ("camera", "first_frame", "late", "proposed"),
    [
        # n(f) = f r + o: ten match frames are 20 frames of a camera with twice the frame rate.
        ({"fps": 100.0, "offset_frames": 20}, 0, -10.0, 40),
        # Of two match frames with one image, the second is a match frame late: 0.5 on average.
        ({"fps": 25.0, "offset_frames": 20}, 0, -10.0 + 0.5, 25),
        ({"offset_frames": ((0, 0.4),)}, 0, -0.4, ((0, 0.4),)),
        # What is stated outside of the clip stays, but for the offset.
        ({"offset_frames": ((740, 2), (741, -3))}, 1000, 1.0, ((740, 1), (741, -4))),
        ({"offset_frames": ((0, 0), (90000, -6))}, 45000, 1.0, ((0, -1.0), (90000, -7.0))),
    ],
)
def test_offsets_are_in_the_cameras_own_frames_for_the_whole_match(
    camera, first_frame, late, proposed
):
    clips = {"clip": {"first_frame": first_frame, "frame_count": 30000}}
    spec = match_spec({"a": {}, "b": camera}, clips, fps=50.0)
    std, empty = np.full(2, 0.05), np.empty(0)
    found = Synchronization(np.array([0.0, late]), std, ("", ""), empty, empty, ((0, 1),))
    row = propose(spec, spec.clips[0], ["a", "b"], [[(0, 0.0)], [(0, late)]], 1, found)
    np.testing.assert_allclose(row.proposed, proposed, atol=0.02)


def test_a_first_camera_that_drifts_changes_no_other_offset():
    spec = match_spec("abc", {"clip": {"frame_count": 1001}}, fps=50.0)
    std, empty = np.full(3, 0.05), np.empty(0)
    found = Synchronization(np.zeros(3), std, ("", "", ""), empty, empty, ((0, 1, 2),))
    courses = [[(0, 0.0), (1000, 8.0)], [(0, 0.0)], [(0, 3.0)]]
    rows = [propose(spec, spec.clips[0], list("abc"), courses, c, found) for c in range(3)]
    assert [row.proposed for row in rows] == [((0, 0.0), (1000, -8.0)), 0, -3]
    assert {row.relative_to for row in rows} == {"b"}


SIZE = (640, 480)
FOCAL = 520.0
OPTIONS = ("--columns", "7", "--rows", "4", "--square", "0.06")


def photograph(rng):
    """An image of a tilted checkerboard with 7 x 4 inner corners, without distortion."""
    side = 40
    squares = np.indices((5, 8)).sum(axis=0) % 2 * 255
    page = np.kron(squares, np.ones((side, side))).astype(np.uint8)
    page = cv2.copyMakeBorder(page, side, side, side, side, cv2.BORDER_CONSTANT, value=255)
    height, width = page.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    places = np.column_stack([(corners / side - [5.0, 3.5]) * 0.06, np.zeros(4)])
    turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
    at = places @ turn.T + [*rng.uniform(-0.04, 0.04, 2), 0.75]
    shown = FOCAL * at[:, :2] / at[:, 2:] + [319.5, 239.5]
    way = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), shown.astype(np.float32))
    return cv2.warpPerspective(page, way, SIZE, flags=cv2.INTER_AREA, borderValue=128)


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    """Images of camera `a`, a video of camera `b`."""
    folder, rng = tmp_path_factory.mktemp("boards"), np.random.default_rng(2)
    pictures = [photograph(rng) for _ in range(9)]
    (folder / "int_a_img").mkdir()
    for n, picture in enumerate(pictures[:8]):
        cv2.imwrite(str(folder / "int_a_img" / f"{n}.png"), picture)
    cv2.imwrite(str(folder / "int_a_img" / "9.png"), np.full(SIZE[::-1], 99, np.uint8))
    frames = [np.repeat(picture[..., None], 3, axis=2) for picture in pictures for _ in range(5)]
    write_video(folder / "b.mp4", frames, 10.0)
    return folder


def test_images_and_a_video_become_lenses(boards, tmp_path):
    out, plot = tmp_path / "lenses.toml", tmp_path / "lens.svg"
    result = invoke("calibrate", boards, *OPTIONS, "--out", out, "--plot", plot, "--json")
    assert result.exit_code == 0, result.exception
    told = json.loads(result.stdout)["cameras"]
    assert told["a"]["left_out"] == {"8": "no whole board found"}
    assert told["a"]["images"] == 8
    assert told["b"]["images"] >= 7
    for lens in read_lens_toml(out, {"a": SIZE, "b": SIZE}).values():
        assert lens.focal_px == pytest.approx(FOCAL, abs=max(3.0, 4.0 * lens.focal_std_px))
    assert "<svg" in plot.read_text()
    refused = invoke("calibrate", boards, *OPTIONS, "--out", out, "--camera", "a")
    assert "a new file" in str(refused.exception), "people edit lenses"


def test_folders_and_videos_of_boards_are_called_as_cameras(tmp_path, monkeypatch):
    for name in ("cam.1", "cam.2", "int_Süd 1.2_img"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0.png").touch()
    assert [*_cameras(tmp_path, None)] == ["cam.1", "cam.2", "Sud-1.2"]
    (tmp_path / "cam.2.mp4").touch()
    with pytest.raises(InputError, match=r"each camera, found cam\.2 and cam\.2\.mp4"):
        _cameras(tmp_path, None)
    monkeypatch.chdir(tmp_path / "cam.1")
    assert [*_cameras(Path(), None)] == ["cam.1"]


def test_squares_in_place_of_corners_are_told(boards, tmp_path):
    out = tmp_path / "lenses.toml"
    options = ("--columns", "8", "--rows", "5", "--square", "0.06", "--camera", "a")
    result = invoke("calibrate", boards, *options, "--out", out)
    assert "a: the board has 7 x 4 inner corners; 8 x 5 is its number of squares" in result.stderr
    assert "a: 9.png is left out: no whole board found" in result.stdout
    lens = read_lens_toml(out, {"a": SIZE})["a"]
    assert lens.focal_px == pytest.approx(FOCAL, abs=max(3.0, 4.0 * lens.focal_std_px))


@pytest.mark.parametrize(
    ("place", "options", "kind", "told"),
    [
        ("nowhere", (), InputError, "nowhere: expected a folder of images or a video for each cam"),
        (".", ("--camera", "c"), UsageError, "--camera c: expected one of b, a, found 'c'"),
        (".", ("--marker", "0.04"), UsageError, "expected --charuco together with --marker"),
        (".", ("--plot", "lens.doc"), UsageError, "lens.doc: expected a file name that ends with"),
        ("int_a_img", ("--rows", "5"), InputError, "a: board images: expected 4 images or more"),
    ],
)
def test_what_is_wrong_is_told(boards, tmp_path, place, options, kind, told):
    out = tmp_path / "lenses.toml"
    result = invoke("calibrate", boards / place, *OPTIONS, *options, "--out", out)
    assert isinstance(result.exception, kind), result.exception
    assert told in str(result.exception)
    assert not out.exists()


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A match without a pitch and calibration, with lenses; and the true cameras."""
    folder = tmp_path_factory.mktemp("lab") / "lab"
    options = ("--seed", 1, "--duration", 6, "--cameras", 4, "--calibrated")
    options += ("--no-stills", "--no-video")
    succeed("simulate", "--scenario", "tiny", "--out", folder, *options)
    file = folder / "match.yaml"
    content = yaml.safe_load(file.read_text()) | {"match_id": "lab", "pitch": "none"}
    content["cameras"] = [each for each in content["cameras"] if each["kind"] == "static"]
    content["clips"] = [
        {key: value for key, value in clip.items() if not key.startswith("broadcast")}
        for clip in content["clips"]
    ]
    file.write_text(yaml.safe_dump(content))
    known = {each["id"] for each in content["cameras"]}
    for place in (folder / "detections").iterdir():
        if place.stem not in known:
            place.unlink()
    for name in ("annotations", "reference", "estimates", "broadcast"):
        shutil.rmtree(folder / name, ignore_errors=True)
    truth = read_calibration(folder / "calibration.toml")
    (folder / "calibration.toml").unlink()
    (folder / "pitch.json").unlink()
    stds = {"focal_std_px": 3.0, "principal_point_std_px": 3.0, "distortion_std": 0.005}
    kept = ("id", "image_size", "principal_point_px", "distortion")
    lenses = {
        name: LensCalibration(
            **{key: getattr(one, key) for key in kept},
            focal_px=float(np.mean(one.focal_px)),
            **stds,
        )
        for name, one in truth.items()
    }
    write_lens_toml(folder / "lenses.toml", lenses)
    return folder, truth


@pytest.mark.slow
def test_cameras_are_found_and_written_in_place_of_lenses(server, lab, tmp_path):
    folder, truth = lab
    options = ("--project", tmp_path / "p", "--stature", "1.83")
    found = succeed("locate-cameras", folder, *options, "--json").json
    assert found["written"] == [] and found["people"] >= 1
    assert set(found["cameras"]) == set(truth)
    shown = succeed("locate-cameras", folder, *options, "--apply").out
    assert "cameras by the people" in shown and "calibration.toml" in shown
    written = read_calibration(folder / "calibration.toml")
    assert not (folder / "lenses.toml").exists() and (folder / "lenses.toml.before").exists()
    places = np.array([Camera.from_calibration(written[name]).center for name in truth])
    right = np.array([Camera.from_calibration(truth[name]).center for name in truth])
    motion = align(places, right, with_scale=True)
    far = np.linalg.norm(right - right.mean(axis=0), axis=1).mean()
    off = np.linalg.norm(motion.apply(places) - right, axis=1)
    assert off.max() < 0.03 * far
    stated = np.array([found["cameras"][name]["position_std_m"] for name in truth])
    assert (off < 4.0 * stated + 0.05).all()
    refused = invoke("locate-cameras", folder, *options, "--apply")
    assert isinstance(refused.exception, InputError)
    assert "calibration.toml: expected no calibration there yet" in str(refused.exception)


def test_unequal_focal_lengths_widen_the_lens_or_are_refused(tmp_path):
    def lens(*focal):
        size = {"image_size": (1440, 1080), "principal_point_px": (719.5, 539.5)}
        given = calibration("a", **size, focal_px=focal)
        folder = SimpleNamespace(folder=tmp_path, lenses={}, calibrations={"a": given})
        return _lens(SimpleNamespace(folder=folder), "a")

    assert lens(1000.0, 1010.0).focal_std_px == 5.0
    with pytest.raises(InputError, match=r"calibration.toml: a.matrix: .*1050 and 1400"):
        lens(1050.0, 1400.0)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("--clip second", "--clip second: expected one of clip, found 'second'"),
        ("--plot clocks.doc", "clocks.doc: expected a file name that ends with .svg, .pdf"),
    ],
)
def test_wrong_options_are_told_before_anything_is_computed(shifted, tmp_path, options, told):
    Store.create(tmp_path / "p")
    result = invoke("synchronize", shifted, "--project", tmp_path / "p", *options.split())
    assert isinstance(result.exception, UsageError)
    assert told in str(result.exception)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("", "--stature: expected either --stature or --distance"),
        ("--stature 1.8 --distance cam00 cam01 3", "found both"),
        ("--distance cam00 cam09 3", "--distance cam00 cam09 3: expected two of the"),
        ("--stature 1.8 --clip b", "--clip b: expected one of"),
    ],
)
def test_wrong_options_of_locating_are_told_before_anything_is_computed(
    lab, tmp_path, options, told
):
    result = invoke("locate-cameras", lab[0], "--project", tmp_path / "p", *options.split())
    assert isinstance(result.exception, UsageError)
    assert told in str(result.exception)
