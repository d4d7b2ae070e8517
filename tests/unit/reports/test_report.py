"""Reports, their figures, overlay videos, and recordings for a viewer."""

import base64
import hashlib
import json
import re
import subprocess
import sys
from datetime import timedelta
from html import unescape
from html.parser import HTMLParser
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import xarray as xr
from camera_builders import look_at_camera, plain_camera
from matplotlib.figure import Figure
from run_records import AT, run_record

from data_contracts.conventions import COCO17, COCO17_BONES
from data_contracts.evaluation import CameraErrors, CameraEvaluation, Evaluation
from data_contracts.pitch import PitchSpec
from data_contracts.run import UnitFailure
from flows.reports import clip_video, clips
from flows.reports.people import body_tables
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.dataset.benchmark import Sample
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.tables import Positions
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.reports.bodies import BodyTracks
from worldpose.reports.clips import plot_stadium
from worldpose.reports.data_set import plot_methods
from worldpose.reports.drawing import figure_data, note_undrawn_distortion, write_figure
from worldpose.reports.html_page import CaptionedImage, EmbeddedPage, LinkedFile, Section
from worldpose.reports.rerun_recording import write_recording
from worldpose.reports.run_report import report_page, score_rows
from worldpose.reports.videos import MARGIN_M, PIXELS_PER_M, minimap_frames, overlay_frames

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJg"
)


def run(**changes):
    plain = {
        **{"run_id": "0003", "match_id": "tiny-1", "parent": "0002", "state": "partial"},
        "results": {"ingest/cam00": "0" * 32, "tracking/clip": "1" * 32},
        "executed": ("tracking/clip",),
        "reused": ("ingest/cam00",),
        "failed": (
            UnitFailure(unit="triangulation/clip", error="E", message="<script>no</script>"),
        ),
        "figures": {"tracking/clip": {"persons": 5.0, "mean_views": 5.8125}},
        "versions": {"numpy": "2.4.0"},
        "finished_at": AT + timedelta(seconds=10.0),
        "seconds": 10.0,
    }
    return run_record(**{**plain, **changes})


class Page(HTMLParser):
    """Rows of cells, addresses and unbalanced tags of a page."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.addresses, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img", "input"):
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        self.addresses += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def test_units_say_what_happened_to_them():
    asked = run(overrides={"tracking": {"gate_m": 0.5}})
    scores = Evaluation(mpjpe_mm=23.456, coverage=0.5, frames=100)
    page = Page(report_page("A run", asked, seconds={"tracking/clip": 1.234}, scores=scores))
    assert ["ingest/cam00", "reused", ""] in page.rows
    assert ["tracking/clip", "computed", "1.23"] in page.rows
    assert ["triangulation/clip", "failed: <script>no</script>", ""] in page.rows
    assert ["tracking/clip", "persons", "5"] in page.rows
    assert ["", "mean_views", "5.812"] in page.rows
    assert ["tracking", "gate_m", "0.5"] in page.rows
    distance = "mean distance between estimated and true joints in world coordinates, "
    assert ["Mean joint error", "23.46 mm", f"{distance}without alignment"] in page.rows
    assert ["People found", "50 %"] in [row[:2] for row in page.rows]
    assert not any("Correct limbs" in row for row in page.rows)
    assert page.open == []


def test_every_score_has_a_meaning():
    fields = {**Evaluation.model_fields, **CameraErrors.model_fields}
    assert all(each.title and each.description for each in fields.values())
    errors = CameraErrors(ground_error_p95_m=0.25, coverage=0.5)
    scores = Evaluation(g_mpjpe_mm=80.04, cameras=CameraEvaluation(broadcast=errors))
    assert [row[:3] for row in score_rows(scores)] == [
        ("g_mpjpe_mm", "G-MPJPE", "80.04 mm"),
        ("cameras.broadcast.ground_error_p95_m", "Broadcast cameras: ground error, 95 %", "0.25 m"),
        ("cameras.broadcast.coverage", "Broadcast cameras: frames", "50 %"),
    ]


def pictured(*pictures, heading="Seen"):
    return [Section(heading, tuple(pictures))]


def test_text_is_escaped():
    hostile = pictured(CaptionedImage('"><img', PNG), heading="<script>1</script>")
    tiles = [("<i>3</i>", "<u>")]
    text = report_page("<b>bold</b> & more", run(), seconds={}, sections=hostile, tiles=tiles)
    for tag in ("<b>bold", "<script>", "<i>", "<u>"):
        assert tag not in text
    assert "&lt;b&gt;bold&lt;/b&gt; &amp; more" in text
    assert Page(text).open == []


def test_nothing_is_asked_from_outside():
    linked = Section("Videos", (LinkedFile("goal & corner", 'a "1".mp4'),))
    sections = [Section("Nothing", ()), *pictured(CaptionedImage("from above", PNG)), linked]
    text = report_page("A run", run(), seconds={}, sections=sections)
    assert "Nothing" not in text and "Against the truth" not in text
    assert '<a href="#part1">Seen</a>' in text
    assert '<a href="a%20%221%22.mp4">goal &amp; corner</a>' in text
    page = Page(text)
    jumps = [address for address in page.addresses if address.startswith("#")]
    assert jumps == ["#part1", "#part2", "#last"]
    data, _ = [address for address in page.addresses if address not in jumps]
    assert data[:22] == "data:image/png;base64,"
    assert base64.b64decode(data[22:]) == PNG
    assert not re.search(r"https?:|url\(|@import", text)
    assert "default-src 'none'" in text
    assert "<script" not in text
    assert "script-src" not in text


def test_an_embedded_page_brings_the_one_script_that_the_page_may_run():
    script = 'const a = "&amp; <b>" && 1 < 2;'
    data = '<p title="a">&lt;</p><script data-clip="0">YQ==</script>'
    block = EmbeddedPage('3D "view"', f'{data}<script type="module">{script}</script>')
    text = report_page("A run", run(), seconds={}, sections=[Section("3D view", (block,))])
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{allowed}'" in text
    (frame,) = re.findall(r'<iframe title="([^"]*)" srcdoc="([^"]*)"></iframe>', text)
    assert [unescape(each) for each in frame] == [block.title, block.html]
    assert Page(text).open == []


@pytest.fixture
def figure():
    drawn = Figure(figsize=(3.0, 2.0))
    axes = drawn.subplots()
    axes.set(title="clocks", xlabel="time [s]", ylabel="offset [frames]")
    axes.plot([0.0, 1.0, 2.0], [1.0, np.nan, 1.23456789], label="cam00")
    axes.scatter([4.0], [5.0])
    axes.bar([10.0], [3.0], width=2.0)
    axes.quiver([1.0], [2.0], [0.5], [-0.5])
    axes.fill_between([0.0, 1.0], [0.0, 0.0], [1.0, 1.0], label="region")
    axes.imshow(np.zeros((4, 6)), extent=(0.0, 1.0, 0.0, 1.0))
    axes.annotate("kick", (1.5, 2.5))
    return drawn


def test_the_data_are_the_numbers_that_were_drawn(figure):
    (panel,) = figure_data(figure)
    assert (panel["title"], panel["x"], panel["y"]) == ("clocks", "time [s]", "offset [frames]")
    found = {each["kind"]: each for each in panel["series"]}
    assert len(found) == len(panel["series"]) == 7
    assert found["line"] == {
        "kind": "line",
        "label": "cam00",
        "x": [0.0, 1.0, 2.0],
        "y": [1.0, None, 1.234568],
    }
    assert (found["points"]["x"], found["points"]["y"]) == ([4.0], [5.0])
    assert found["bar"] == {"kind": "bar", "x": [9.0], "y": [0.0], "width": [2.0], "height": [3.0]}
    arrows = [found["arrows"][name] for name in ("x", "y", "dx", "dy")]
    assert arrows == [[1.0], [2.0], [0.5], [-0.5]]
    assert found["areas"]["label"] == "region"
    assert {(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (None, None)} == set(
        zip(found["areas"]["x"], found["areas"]["y"], strict=True)
    )
    assert (found["image"]["width"], found["image"]["height"]) == (6, 4)
    assert found["text"] == {"kind": "text", "text": "kick", "x": [1.5], "y": [2.5]}


def test_files_are_equal_for_equal_figures_and_text_stays_text(figure, tmp_path):
    first = write_figure(figure, tmp_path / "a", "two clocks, cam00 ± 1")
    again = write_figure(figure, tmp_path / "b", "two clocks, cam00 ± 1")
    assert [path.name for path in first] == ["a.svg", "a.pdf", "a.json"]
    for one, other in zip(first, again, strict=True):
        assert one.read_bytes() == other.read_bytes()
    svg, pdf, data = first
    assert ">offset [frames]<" in svg.read_text()
    assert pdf.read_bytes().startswith(b"%PDF-")
    shown = json.loads(data.read_text())
    assert shown["caption"] == "two clocks, cam00 ± 1"
    assert shown["panels"] == figure_data(figure)


def test_distortion_that_a_view_lacks_is_stated():
    lens = np.array([-0.1, 0.02, 0.0, 0.0, 0.0])
    matrix = np.array([[900.0, 0.0, 639.5], [0.0, 900.0, 359.5], [0.0, 0.0, 1.0]])
    bent, plain = (
        Camera.from_matrices(matrix, each, np.eye(3), np.zeros(3), (1280, 720))
        for each in (lens, 0.0 * lens)
    )
    corner = cv2.undistortPoints(np.zeros((1, 1, 2)), matrix, lens, P=matrix)[0, 0]
    said = note_undrawn_distortion({"a": bent, "b": plain})["distortion"]
    assert said.endswith(f"by up to a {np.hypot(*corner):.0f} px")
    assert note_undrawn_distortion({"b": plain}) == {}


def scene():
    joints = np.random.default_rng(0).normal(size=(4, 2, 17, 3))
    joints[2, 1] = np.nan
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    camera = plain_camera(
        np.full(4, 3000.0),
        (960.0, 540.0),
        Rigid(np.tile(rotation, (4, 1, 1)), np.tile([0.0, 2.0, 70.0], (4, 1))),
    )
    return JointTracks(np.arange(40, 44), np.array([3, 8]), joints), camera


def test_recording_has_people_markings_and_cameras(tmp_path):
    pytest.importorskip("rerun")
    tracks, camera = scene()
    path = tmp_path / "clip.rrd"
    write_recording(
        path, tracks, 50.0, cameras={"north": camera[0], "broadcast": camera}, pitch=PitchSpec()
    )
    assert "/world/pitch" in printed(path)
    # The printer cuts long cells: each person's first bone begins there, by frame.
    starts = re.findall(r"\[\[\[([^\]]+)\]", printed(path, "/world/people"))
    found = np.array([[float(number) for number in start.split(",")] for start in starts])
    np.testing.assert_allclose(found, tracks.joints[:, 0, COCO17_BONES[0][0]], atol=1e-6)
    for name in ("north", "broadcast"):
        camera_text = printed(path, f"/world/cameras/{name}")
        # The camera stands at (0, -70, 2) and looks along +y with z up; columns come first.
        assert "[[-0.0, -70.0, 2.0]]" in camera_text
        assert "[[1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0]]" in camera_text
        assert "[[3000.0, 0.0, 0.0, 0.0, 3000.0, 0.0, 960.0, 540.0, 1.0]]" in camera_text


def printed(path, place=None):
    """Return the viewer program's listing of a recording, or of one entity."""
    chosen = () if place is None else ("--entity", place)
    return subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", *chosen, path],
        capture_output=True,
        text=True,
        check=True,
    ).stdout


SIZE = (322, 182)


def camera(frames, focal=600.0):
    one = look_at_camera((0.0, -60.0, 20.0), (0.0, 0.0, 0.0), focal, SIZE)
    return Camera.stack([one] * frames)


def tracks(frames):
    joints = np.full((frames, 1, 17, 3), np.nan)
    # A bone of 2 m, upright, on the centre mark: from the left shoulder to the left elbow.
    joints[0, 0, 5], joints[0, 0, 7] = [4.0, 0.0, 0.0], [4.0, 0.0, 2.0]
    return JointTracks(
        frames=np.arange(10, 10 + frames),
        person_ids=np.array([3]),
        joints=joints,
        covariance=np.full((frames, 1, 17, 3, 3), np.nan),
        views=np.zeros((frames, 1, 17), dtype=np.int64),
    )


def drawn(frames, pitch=None, people=None, bodies=None, focal=600.0):
    black = [np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8) for _ in frames]
    people = tracks(2) if people is None else people
    return list(
        overlay_frames(black, camera(len(frames), focal), people, np.array(frames), pitch, bodies)
    )


def test_a_bone_is_where_the_camera_has_it():
    picture, before, after = drawn([10, 11, 300])
    assert picture.shape == (90, 160, 3)  # 161 x 91 loses a row and a column
    assert not before.any() and not after.any()  # people are drawn in their own frames only
    rows, columns = np.nonzero(picture.any(axis=-1))
    ends = camera(1)[0].project(np.array([[4.0, 0.0, 0.0], [4.0, 0.0, 2.0]]))
    low, high = 0.5 * ends.min(axis=0) - 0.25, 0.5 * ends.max(axis=0) - 0.25
    # A line one pixel wide with soft borders.
    np.testing.assert_allclose([columns.min(), rows.min()], low, atol=1.6)
    np.testing.assert_allclose([columns.max(), rows.max()], high, atol=1.6)


def standing(places, ids):
    """People at positions (persons, 2) [m] in frame 10 and absent in frame 11."""
    model = load_open_body()
    transl = np.full((2, len(ids), 3), np.nan)
    transl[0] = np.concatenate([places, np.full((len(ids), 1), 1.2)], axis=1)
    upright = np.tile([np.pi / 2, 0.0, 0.0], (2, len(ids), 1))
    poses = BodyParameters(np.zeros(10), upright, np.zeros(69), transl)
    frames, ids = np.array([10, 11]), np.array(ids)
    joints = fold_keypoints(model, COCO17)(poses)
    return JointTracks(frames, ids, joints), BodyTracks(frames, ids, poses, model)


CLOSE = 3000.0
"""Focal length [px] at which people are 40 px tall in the half image."""


def middle(place):
    """Pixel of a person's chest in the half-size image."""
    x, y = 0.5 * camera(1, CLOSE)[0].project(np.array([[*place, 1.35]]))[0] - 0.25
    return round(y), round(x)


def test_bodies_are_seen_through_and_replace_bones():
    people, bodies = standing([[0.0, 0.0]], [3])
    skin = drawn([10], people=people, bodies=bodies, focal=CLOSE)[0]
    bones = drawn([10], people=people, focal=CLOSE)[0]
    # Between the sides of the trunk there is no bone.
    assert bones[middle([0.0, 0.0])].max() == 0
    assert 40 < skin[middle([0.0, 0.0])].max() < 0.75 * 255
    assert not drawn([11], people=people, bodies=bodies, focal=CLOSE)[0].any()


def places(other):
    """Person 3 in frame 7, triangulated, and 4 in frames 7 and 8, by the feet alone."""
    xy = np.array([[[20.0, 10.0], other], [[np.nan, np.nan], other]])
    on_plane, names = np.array([[False, True], [False, True]]), ["", "ann"]
    unknown = np.zeros((2, 2, 2, 2)), np.full(2, np.nan), np.ones((2, 2))
    return Positions(np.array([7, 8]), np.array([3, 4]), names, on_plane, xy, *unknown)


def test_people_whom_only_their_feet_place_are_marked_in_images(monkeypatch):
    monkeypatch.setattr(clip_video, "clip_positions", lambda *_: places([2.0, 1.0]))
    one = JointTracks(np.array([7, 8]), np.array([3]), np.full((2, 1, 17, 3), np.nan))
    one.joints[0] = 5.0
    marked, has_marks = clip_video.mark_places(None, "clip", one, PitchSpec())
    assert has_marks
    assert marked.person_ids.tolist() == [3, 4]
    np.testing.assert_array_equal(marked.joints[:, 0], one.joints[:, 0])
    feet, hips = (marked.joints[:, 1, list(each)] for each in ((15, 16), (11, 12)))
    np.testing.assert_allclose(feet, np.broadcast_to([2.0, 1.0, 0.0], (2, 2, 3)), atol=1e-3)
    np.testing.assert_allclose(hips.mean(axis=1), [[2.0, 1.0, 1.0]] * 2, atol=1e-3)
    assert drawn([8], people=marked)[0].any()
    assert not drawn([8], people=one)[0].any()


def test_bodies_of_nobody_have_no_table():
    fits = xr.Dataset(coords={"person": np.zeros(0, int)}, attrs={"without_body": {"3": "feet"}})
    fitted = SimpleNamespace(record=SimpleNamespace(figures={}))
    fitted = type("Fitted", (dict,), vars(fitted))({"body_fitting/clip": fits})
    (table,) = body_tables(fitted, ("clip",))
    assert table.rows == (("3", "feet"),)


def test_people_are_drawn_at_their_places_and_in_the_way_of_their_kind():
    first, second = minimap_frames(places([-20.0, -10.0]), PitchSpec())
    assert first.shape == (780, 1150, 3) and first.dtype == np.uint8

    def colour(image, x, y):
        row = (34.0 + MARGIN_M - y) * PIXELS_PER_M
        return image[round(row), round((52.5 + MARGIN_M + x) * PIXELS_PER_M)].astype(int)

    grass = colour(second, 20.0, 10.0)
    assert np.abs(colour(first, 20.0, 10.0) - grass).max() > 50  # a disc is filled
    np.testing.assert_array_equal(colour(first, -20.0, -10.0), grass)  # a ring is not
    assert np.abs(colour(first, -20.8, -10.0) - grass).max() > 50


def test_pictures_of_nobody_are_drawn():
    """No person, nobody who is true: each is a picture."""
    nobody = JointTracks(tracks(3).frames, np.zeros(0, int), np.zeros((3, 0, 17, 3)))
    assert plot_stadium({}, "", nobody).startswith(b"\x89PNG")
    gone = np.full((1, 17, 3), np.nan)
    for seen_by in (None, camera(1)[0]):
        for found in (gone, np.ones((1, 17, 3))):
            sample = Sample("a", 0, seen_by, gone, {"m": found})
            assert plot_methods(sample).startswith(b"\x89PNG")


def test_a_clip_has_the_true_paths_of_its_own_frames(monkeypatch):
    """Frames 100 and 101 of the reference are those of the clip; nobody is reconstructed."""
    drawn = []
    nobody = JointTracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 0, 17, 3)))
    stand_ins = {
        "static_cameras": lambda *_: {},
        "joint_tracks": lambda *_: nobody,
        "shown_pitch": lambda *_: None,
        "placed_joints": lambda *_: {"inliers": xr.DataArray(np.zeros((0, 0, 0, 0)), dims=DIMS)},
        "plot_paths": lambda _, truth, **__: drawn.append(truth) or b"",
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(clips, name, stand_in)
    spec = SimpleNamespace(clip=lambda _: SimpleNamespace(first_frame=100, frame_count=2))
    match = SimpleNamespace(folder=SimpleNamespace(spec=spec))
    joints = np.arange(4.0)[:, None, None, None] * np.ones((4, 1, 17, 3))
    truth = JointTracks(np.array([99, 100, 101, 102]), np.array([7]), joints)
    clips.clip_pictures(None, None, match, "b", truth)
    clips.clip_pictures(None, None, match, "b")
    assert (drawn[0].frames.tolist(), drawn[0].joints[:, 0, 0, 0].tolist()) == ([100, 101], [1, 2])
    assert drawn[1] is None


DIMS = ("frame", "camera", "person", "joint")
