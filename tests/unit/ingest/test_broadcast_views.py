"""Broadcast cameras of a clip: their names, their files, and the images at match frames."""

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.errors import InputError
from worldpose.ingest.clock import ImageClock, rows_at
from worldpose.ingest.footage import footage_size, image_clock, unit_frames
from worldpose.ingest.match_folder import read_match

SIZE = {"width": 1920, "height": 1080}


def match(broadcast, offsets=0.0, **fast):
    cameras = [CameraSpec(id="one", **SIZE)]
    cameras += [CameraSpec(id=name, kind="broadcast", **(SIZE | fast)) for name in ("main", "fast")]
    clip = {"id": "goal", "first_frame": 100, "frame_count": 6}
    clip |= {"broadcast": broadcast, "broadcast_offset_frames": offsets}
    return MatchSpec(match_id="m", fps=50.0, cameras=tuple(cameras), clips=(ClipSpec(**clip),))


@pytest.mark.parametrize(
    ("broadcast", "names"),
    [
        (None, []),
        ("main", ["goal"]),
        (["main"], ["goal"]),
        (["main", "fast"], ["goal.main", "goal.fast"]),
    ],
)
def test_a_camera_of_several_has_its_name_after_the_clips(broadcast, names):
    spec = match(broadcast)
    assert list(spec.broadcast_views) == list(spec.views_of("goal")) == names
    assert [spec.filming_camera(name).id for name in names] == [*spec.clips[0].moving_cameras]
    assert MatchSpec.model_validate_json(spec.model_dump_json(), strict=True) == spec


@pytest.mark.parametrize(
    ("broadcast", "offsets", "told"),
    [
        ([], 0.0, "an empty list"),
        (["main", "main"], 0.0, "a camera twice"),
        (["main", "one"], 0.0, "names broadcast camera 'one'"),
        (["main", "fast"], 3.0, r"give each one's, as \{main: 3, fast: 0\}"),
        (["main", "fast"], {"main": 3.0}, r"expected those of its broadcast cameras"),
        (5, 0.0, "the name of a camera, or a list of names"),
        ("main", "late", "a number, or a number for each broadcast camera"),
    ],
)
def test_cameras_and_offsets_that_cannot_be_assigned_are_refused(broadcast, offsets, told):
    with pytest.raises(ValidationError, match=told):
        match(broadcast, offsets)


def test_each_view_has_its_own_size_rate_and_offset():
    spec = match(["main", "fast"], {"main": 7.0, "fast": 12.4}, fps=60.0, width=3840, height=2160)
    assert footage_size(spec, "goal.fast") == (3840, 2160)
    frames = unit_frames(spec, "goal.fast")
    assert frames.rate == 1.2
    # Images 12.4, 13.6, 14.8, 16.0, 17.2 and 18.4 would be of the match frames.
    assert frames.numbers(frames.frame).tolist() == [12, 14, 15, 16, 17, 18]
    clock = image_clock(spec, "goal.fast")
    late = np.array([-0.4, 0.4, 0.2, 0.0, -0.2, -0.4]) / 1.2
    np.testing.assert_allclose(clock.late, late, atol=1e-9)
    assert clock.images.tolist() == [12, 13, 14, 15, 16, 17, 18]
    np.testing.assert_allclose(clock.frame_row, (clock.images - 12.4) / 1.2)
    assert clock.frame_of(np.array([11, 12, 13, 14, 99])).tolist() == [0, 0, 0, 1, 5]


@pytest.mark.parametrize("rate", [1.0, 1.1988, 0.5, 2.0])
@pytest.mark.parametrize("late", [0.0, 1.7, -0.4])
def test_what_images_show_is_moved_to_the_frames_and_back(rate, late):
    frame = np.arange(100, 130)
    clock = ImageClock.of(frame, 12.3 - 100 * rate, rate, 12.3)
    motion = np.stack([3.0 * np.arange(30.0), 5.0 - np.arange(30.0)], axis=-1)
    seen = clock.to_images(motion, late)
    at = (clock.number - 12.3) / rate + late
    inside = np.isfinite(seen[:, 0])
    np.testing.assert_allclose(seen[inside, 0], 3.0 * at[inside], atol=1e-9)
    back = clock.to_frames(seen, late)
    known = np.isfinite(back[:, 0])
    assert known.sum() >= 26
    np.testing.assert_allclose(back[known], motion[known], atol=1e-9)
    # The nearest image is at most half an image away: 3 units per frame.
    near = clock.to_frames(seen, late, whole=True)
    known = np.isfinite(near[:, 0])
    assert known.sum() >= 26
    assert np.abs(near[known] - motion[known]).max() <= 1.5 / min(rate, 1.0) + 1.6


def test_rows_beyond_the_ends_and_next_to_missing_ones_are_missing():
    values = np.array([1.0, np.nan, 5.0])
    found = rows_at(values, np.array([-0.5, 0.0, 0.5, 2.0, 2.1, np.nan]))
    np.testing.assert_array_equal(found, [np.nan, 1.0, np.nan, 5.0, np.nan, np.nan])


@pytest.fixture
def two(match_folder):
    """A match folder whose clip `goal` has two broadcast cameras, with files of one."""
    file = match_folder / "match.yaml"
    content = yaml.safe_load(file.read_text())
    content["cameras"].append({**content["cameras"][2], "id": "tight"})
    content["clips"][0].update(broadcast=["main", "tight"])
    file.write_text(yaml.safe_dump(content))
    return match_folder


def test_files_of_several_cameras_are_named_after_clip_and_camera(two):
    with pytest.raises(InputError, match=r"goal\.main, goal\.tight.*found 'goal\.npz'"):
        read_match(two)
    (two / "detections" / "goal.npz").rename(two / "detections" / "goal.main.npz")
    with pytest.raises(InputError, match=r"camera tight for clip goal.*broadcast/goal\.tight\.mp4"):
        read_match(two)
    (two / "broadcast").mkdir()
    (two / "broadcast" / "goal.tight.mp4").write_bytes(b"video")
    read = read_match(two)
    assert [*read.detections][-1] == "goal.main"
    assert [*read.videos] == ["goal.tight"]
    (two / "broadcast" / "goal.mp4").write_bytes(b"video")
    with pytest.raises(InputError, match=r"goal\.mp4.*broadcast/goal\.main\.mp4"):
        read_match(two)


def test_several_broadcast_cameras_need_static_ones(two):
    file = two / "match.yaml"
    content = yaml.safe_load(file.read_text())
    content["cameras"] = content["cameras"][2:]
    file.write_text(yaml.safe_dump(content))
    for name in ("calibration.toml", "detections/cam1.npz", "detections/cam2.npz"):
        (two / name).unlink()
    (two / "detections" / "goal.npz").rename(two / "detections" / "goal.main.npz")
    with pytest.raises(InputError, match=r"clip goal: broadcast.*one broadcast camera.*tight"):
        read_match(two)


def test_an_offset_of_the_match_rate_is_rounded_and_its_rest_is_lateness():
    spec = match("main", 12.25)
    assert unit_frames(spec, "goal").offset == -88
    assert image_clock(spec, "goal").late.tolist() == [-0.25] * 6
