"""Clips of a turning camera are calibrated; shots of a programme are found and told apart."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import turning_clip as clip
from camera_builders import look_at_camera
from turning_clip import film_empty_pitch

from data_contracts.broadcast_calibration import FRAME_STATUS, KeyFrame
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint
from worldpose.broadcast_calibration.estimate import BroadcastClip, calibrate_broadcast, track
from worldpose.broadcast_calibration.given_camera import GivenCamera
from worldpose.broadcast_calibration.players import People
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.shots import find_shots
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.pan_tilt import camera_angles
from worldpose.simulation.scene import look_at
from worldpose.simulation.settings import RenderingSettings
from worldpose.video.files import VideoReader, index_frames, write_video
from worldpose.video.recordings import cut_video

FRAMES, FPS = 16, 25.0
LOOK = RenderingSettings(light="floodlights", stand_shadow=0.0)
SETTINGS = BroadcastCalibrationSettings(flow_points=250, passes=1)


def grey(picture):
    return np.ascontiguousarray(picture[..., 1])


@pytest.fixture(scope="module")
def true():
    return clip.moving(FRAMES, pan=(-2.0, 6.0))


@pytest.fixture(scope="module")
def pictures(true):
    return [grey(p) for p in clip.film_empty_pitch(true.camera, 5, LOOK)]


@pytest.fixture(scope="module")
def bare(true):
    """The same without any paint."""
    unpainted = LOOK.model_copy(update={"paint": 0.0})
    return [grey(p) for p in clip.film_empty_pitch(true.camera, 5, unpainted)]


def clicks(true, frame, noise=1.0, renamed=None):
    names = [*("center_mark", "center_circle_near", "center_circle_far", "halfway_far")]
    rng = np.random.default_rng(frame)
    points = []
    for name in names:
        pixel = true.camera[frame].project(clip.PITCH.points[name][None])[0]
        if ((pixel > 3.0) & (pixel < true.image_size - 4.0)).all():
            x, y = (float(v) for v in pixel + noise * rng.standard_normal(2))
            points.append(ClickedPoint(name=renamed or name, xy=(x, y)))
            renamed = None
    drawn = clip.draw(true, frame, noise, rng)
    markings = ClickedMarkings.model_validate(
        {"points": [p.model_dump() for p in points], "drawn": drawn}
    )
    return KeyFrame(frame=frame, markings=markings)


def place_errors(camera, true):
    """Distances in the image of places on the pitch that the true camera sees [px]."""
    x, y = np.meshgrid(np.linspace(-25.0, 25.0, 11), np.linspace(-20.0, 20.0, 9))
    places = np.stack([x.ravel(), y.ravel(), clip.PITCH.height(x.ravel(), y.ravel())], axis=-1)
    seen, found = true.camera.project(places), camera.camera.project(places)
    inside = ((seen > 0.0) & (seen < true.image_size - 1.0)).all(axis=-1)
    return np.linalg.norm(found - seen, axis=-1)[inside]


def calibrate(keys, pictures, settings=SETTINGS, **more):
    return calibrate_broadcast(
        clip.PITCH, BroadcastClip(keys, lambda: iter(pictures), FPS, **more), settings
    )


@pytest.fixture(scope="module")
def calibrated(true, pictures):
    return calibrate([clicks(true, 3), clicks(true, 12)], pictures)


def test_two_key_frames_give_every_frame(calibrated, true):
    """Two frames of clicks at 1 px, and lines in every frame."""
    errors = place_errors(calibrated.camera, true)
    assert np.median(errors) < 0.5 and np.percentile(errors, 95.0) < 1.5


def test_a_point_under_a_wrong_name_is_left_out_and_named(true, pictures):
    found = calibrate([clicks(true, 3, renamed="penalty_mark_left"), clicks(true, 12)], pictures)
    assert "penalty_mark_left" in found.report.wrong[3]
    assert any("penalty_mark_left" in reason for reason in found.report.reasons)
    assert np.median(place_errors(found.camera, true)) < 0.5


def test_a_feed_beside_the_static_cameras_is_said_and_corrected_on_request(true, pictures):
    rng = np.random.default_rng(9)
    x, y = np.meshgrid([-6.0, -2.0, 2.0, 6.0, 10.0], [-9.0, -3.0, 4.0, 9.0])
    way = rng.uniform(-6.0, 6.0, (20, 2))

    def joints(frames):
        places = np.stack([x.ravel(), y.ravel()], axis=-1) + frames[:, None, None] / FPS * way
        return (
            np.concatenate([places, np.zeros((*places.shape[:2], 1))], -1)[:, :, None] + clip.SHAPE
        )

    frames = np.arange(FRAMES, dtype=np.float64)
    seen = true.camera.project(joints(frames + 2.0).reshape(FRAMES, -1, 3))
    seen = seen.reshape(FRAMES, 20, 17, 2) + rng.standard_normal((FRAMES, 20, 17, 2))
    people = People(joints(frames), seen, FPS)
    both = (SETTINGS.model_copy(update={"feed_offset": what}) for what in ("report", "correct"))
    said, corrected = (calibrate([clicks(true, 8)], pictures, each, people=people) for each in both)
    # The clock offset of a static camera is at most half a frame.
    assert said.report.feed_offset.frames == pytest.approx(2.0, abs=0.5)
    assert any("frames later in the static cameras" in each for each in said.report.reasons)
    assert corrected.report.reasons == ()
    players = [np.nanmedian(each.report.player_rms) for each in (said, corrected)]
    # People go 0.1 m in two frames, which is 3 px; the noise is 1.4 px.
    assert players[1] < 0.8 * players[0]


@pytest.mark.parametrize(
    ("frames", "message"),
    [([8, 8], "every key frame once"), ([400], "key frames from 0 to 15"), ([], "no key frame")],
)
def test_key_frames_that_the_clip_does_not_have_are_refused(true, pictures, frames, message):
    keys = [clicks(true, 8).model_copy(update={"frame": frame}) for frame in frames]
    if not keys:  # one that tells nothing, with its reason
        point = ClickedPoint(name="center_mark", xy=(400.0, 300.0))
        keys, message = [KeyFrame(frame=2, markings=ClickedMarkings(points=(point,)))], "frame 2"
    with pytest.raises(InputError, match=message):
        calibrate(keys, pictures)


@pytest.mark.parametrize("frames", [FRAMES - 1, FRAMES + 3])
def test_boxes_and_people_have_the_frames_of_the_pictures(true, pictures, frames):
    nobody = People(np.empty((frames, 0, 17, 3)), np.empty((frames, 0, 17, 2)), FPS)
    for given in ({"boxes": np.full((frames, 1, 4), np.nan)}, {"people": nobody}):
        whole = BroadcastClip([clicks(true, 2)], lambda: iter(pictures), FPS, **given)
        with pytest.raises(InputError, match=f"found {FRAMES} pictures, and data of {frames}"):
            track(clip.PITCH, whole, SETTINGS)


def test_a_cut_is_found_and_refused(true, pictures):
    turned = [np.ascontiguousarray(np.rot90(each, 2)) for each in pictures[:3]]
    with pytest.raises(InputError, match=r"cuts before frame 8, 11 of 0 to 14"):
        calibrate([clicks(true, 2)], [*pictures[:8], *turned, *pictures[8:12]])


def test_a_dissolve_and_a_cut_through_black_are_refused(true, pictures):
    center = np.array([40.0, -60.0, 12.0])
    aims = [
        look_at(center, np.array([x, -2.0, 0.0]), 0.0).rotation for x in np.linspace(30, 34, FRAMES)
    ]
    other = replace(true, center=center, rotation=np.stack(aims))
    others = [grey(p) for p in clip.film_empty_pitch(other.camera, 5, LOOK)]
    weights = np.clip(np.arange(FRAMES) / 9.0, 0.0, 1.0)
    mixed = zip(weights, pictures, others, strict=True)
    dissolve = [np.uint8((1.0 - w) * before + w * after) for w, before, after in mixed]
    black = [*pictures[:6], *2 * [np.zeros_like(pictures[0])], *others[8:]]
    for cut in (dissolve, black):
        with pytest.raises(InputError, match=r"no markings there in frames \d+ to 15\. End the"):
            calibrate([clicks(true, 0)], cut)


def test_a_chain_that_black_images_break_is_held_by_the_key_frames_of_both_sides(true, pictures):
    black = np.zeros_like(pictures[0])
    order = [0, 1, 2, 3, 3, 3, 13, 13, 14, 15]
    cut = [black if n in (4, 5) else pictures[each] for n, each in enumerate(order)]
    keys = [clicks(true, 2), clicks(true, 14).model_copy(update={"frame": 8})]
    found = calibrate(keys, cut)
    rest = np.array([0, 1, 2, 3, 6, 7, 8, 9])
    errors = place_errors(found.camera.frames(rest), true.frames(np.array(order)[rest]))
    assert np.percentile(errors, 95.0) < 1.5


def test_without_any_paint_players_hold_the_camera(true, bare):
    rng = np.random.default_rng(8)
    x, y = np.meshgrid([-8.0, -2.0, 4.0, 10.0], [-9.0, 0.0, 9.0])
    places = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=-1)
    joints = np.broadcast_to(places[:, None] + clip.SHAPE, (FRAMES, 12, 17, 3))
    seen = true.camera.project(joints.reshape(FRAMES, -1, 3)).reshape(FRAMES, 12, 17, 2)
    seen = seen + 1.5 * rng.standard_normal(seen.shape)
    away = ((seen < 0.0) | (seen > true.image_size - 1.0)).any(axis=-1, keepdims=True)
    people = People(joints, np.where(away, np.nan, seen), FPS)
    keys = [clicks(true, 3), clicks(true, 12)]
    alone, held = (calibrate(keys, bare, people=who) for who in (None, people))
    assert FRAME_STATUS[held.report.status[8]] == "players"
    assert np.median(place_errors(held.camera, true)) < 0.5
    # Clicks alone do not tell the place as well.
    assert np.median(place_errors(held.camera, true)) < np.median(place_errors(alone.camera, true))


def camera_data(true, pan_off=0.0, focal=1.0, leads=False):
    """Camera data with an offset of the pan [deg], counts of the zoom, and no k1 and k2."""
    values = np.full((FRAMES, 12), np.nan)
    values[:, :3] = np.stack(camera_angles(true.camera), axis=1) + [pan_off, 0.0, 0.0]
    values[:, 3:6] = true.center + [0.2, -0.1, 0.1]
    values[:, 6], values[:, 9] = focal * true.focal, 9e4 - true.focal
    return GivenCamera(values, leads)


def calibrate_given(given, pictures, keys=None):
    size = pictures[0].shape[::-1]
    proposed = given.propose_key_frames(clip.PITCH, size, SETTINGS.prior)
    return calibrate(keys or proposed, pictures, proposed=not keys, given=given)


def test_camera_data_start_a_clip_without_clicks_and_are_compared(true, pictures):
    found = calibrate_given(camera_data(true, 0.1, 1.005, leads=True), pictures)
    errors = place_errors(found.camera, true)
    assert np.median(errors) < 0.7
    said = " ".join(found.report.decisions)
    pan = re.search(r"pan \[deg\] ([+-][0-9.]+) \(median\), within ([0-9.]+)", said)
    assert float(pan[1]) == pytest.approx(0.1, abs=0.08)
    assert float(pan[2]) < 0.02
    assert "rank correlation of zoom counts and focal length: -1.000" in said
    assert not any("camera data" in reason for reason in found.report.reasons)


def test_paint_refuses_camera_data_of_another_view(true, pictures):
    with pytest.raises(InputError, match=r"painted lines where the camera data project them"):
        calibrate_given(camera_data(true, 2.0, leads=True), pictures)


def test_key_frames_overrule_camera_data_that_contradict_them(calibrated, true, pictures):
    keys = [clicks(true, 3), clicks(true, 12)]
    given = camera_data(true, pan_off=20.0, focal=np.nan)
    with pytest.raises(InputError, match="camera data with angles, place and focal"):
        calibrate_given(given, pictures)
    found = calibrate(keys, pictures, given=given)
    (told,) = [each for each in found.report.reasons if "are no prior: pan [deg]" in each]
    assert float(told.rpartition(" ")[2]) == pytest.approx(20.0, abs=0.2)
    np.testing.assert_allclose(found.camera.focal, calibrated.camera.focal, rtol=1e-9)


SIZE = np.array([320, 180])
SHOT_FPS = 10.0


def filmed(center, aims, focal):
    """Images of an empty pitch from a tripod."""
    cameras = Camera.stack([look_at_camera(center, (*aim, 0.0), focal, SIZE) for aim in aims])
    return list(film_empty_pitch(cameras, 3))


def sweep(begin, end, count):
    return [(x, -4.0) for x in np.linspace(begin, end, count)]


def wipe():
    """A growing disc: 0.8 s."""
    pictures = []
    for radius in range(20, 84, 8):
        picture = np.full((180, 320, 3), (30, 30, 160), np.uint8)
        cv2.circle(picture, (160, 90), radius, (220, 200, 40), -1)
        pictures.append(picture)
    return pictures


@pytest.fixture(scope="module")
def programme():
    """Names of what follows one another, and its images."""
    main = (0.0, -80.0, 16.0)
    shots = [
        ("main", filmed(main, sweep(-25.0, 15.0, 44), 600.0)),
        ("crowd", filmed((0.0, 0.0, 3.0), [(x, 700.0) for x in range(-300, 300, 30)], 500.0)),
        ("still", filmed(main, [(10.0, 5.0)] * 44, 650.0)),
        ("low", filmed((-52.0, -40.0, 2.0), [(x, 100.0) for x in range(-40, 44, 2)], 500.0)),
        ("wipe", wipe()),
        ("replay", filmed(main, sweep(0.0, 25.0, 44), 700.0)),
        ("wipe", wipe()),
        ("later", filmed(main, sweep(20.0, -20.0, 44), 600.0)),
        ("short", filmed(main, sweep(10.0, 30.0, 20), 600.0)),
    ]
    return shots, [picture for _, pictures in shots for picture in pictures]


@pytest.fixture(scope="module")
def found(programme):
    return list(find_shots(enumerate(programme[1]), SHOT_FPS))


def test_shots_end_where_pictures_were_cut_together(programme, found):
    shots, _ = programme
    begins = np.cumsum([0, *(len(pictures) for _, pictures in shots)])
    expected = [
        (begin, len(pictures))
        for begin, (name, pictures) in zip(begins, shots, strict=False)
        if name != "wipe"
    ]
    assert [(shot.first, shot.count) for shot in found] == expected


def test_only_live_pans_of_the_main_camera_are_proposed(found):
    names = ("main", "crowd", "still", "low", "replay", "later", "short")
    said = dict(zip(names, (shot.unfit for shot in found), strict=True))
    assert said["main"] == said["later"] == ()
    assert "too little grass" in said["crowd"]
    assert said["still"] == ("hardly a pan",)
    assert "too little grass" in said["low"]
    assert said["replay"] == ("between two wipes, as replays are",)
    assert "shorter than 4 s" in said["short"]


@pytest.mark.parametrize(("damaged", "parts"), [(None, [(0, 199)]), (101, [(0, 101), (102, 97)])])
def test_a_fast_video_has_the_shots_of_all_its_frames(damaged, parts):
    # Four seconds at 50 frames per second, of which every other one is looked at.
    noise = np.random.default_rng(0).integers(40, 120, (18, 52, 3), dtype=np.uint8)
    ground = cv2.resize(noise, (520, 180), interpolation=cv2.INTER_NEAREST)
    pictures = [None if n == damaged else ground[:, n : n + 320].copy() for n in range(200)]
    found = list(find_shots(enumerate(pictures), 50.0))
    assert [(shot.first, shot.count) for shot in found] == parts
    assert ["shorter than 4 s" in shot.unfit for shot in found] == [len(parts) > 1] * len(parts)


def test_a_stretch_is_cut_out_picture_for_picture(programme, tmp_path):
    video, cut = tmp_path / "programme.mp4", tmp_path / "cut.mp4"
    write_video(video, programme[1][:90], SHOT_FPS)
    place = cut_video(video, 41, 70, cut)
    # A key frame a second: 10 images.
    assert (place, index_frames(cut).fps) == (41 % 10, pytest.approx(SHOT_FPS))
    with VideoReader(video) as one, VideoReader(cut) as two:
        for number in range(29):
            assert np.array_equal(one.frame(41 + number), two.frame(place + number))
        small = dict(one.readable(40, 42, width=160))
        assert small[41].shape == (90, 160, 3)
        assert abs(small[41].mean() - one.frame(41).mean()) < 1.0
    with pytest.raises(InputError, match="90 pictures"):
        cut_video(video, 80, 91, tmp_path / "none.mp4")
