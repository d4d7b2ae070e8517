"""Matches without truth whose camera is knocked or loses frames, from import to export."""

import json

import numpy as np
import pytest
import yaml
from camera_builders import look_at_camera
from command_line import succeed
from imported_people import apart_from, circling, import_people, seen_by

from flows.registering import open_match
from flows.reports.cameras import health_picture
from worldpose.camera_consistency.health import judge_health
from worldpose.formats.joints_file import read_joints
from worldpose.store.store import Store, open_run

FRAMES, FPS, BAD = 125, 25, "cam2"
KNOCK = np.array([25.0, -12.0])
MIDDLE = np.array([960.0, 540.0])
"""Of the images [px]."""


@pytest.fixture
def joints(tiny):
    return circling(tiny, np.arange(FRAMES + 10) / FPS)


@pytest.fixture
def imported(server, joints, tmp_path):
    """Returns what imports a match; `spoil` changes the pixels of the bad camera, or by name."""

    def build(spoil, **others):
        rng, cameras, pixels = np.random.default_rng(0), {}, {}
        for turn in range(4):
            name, angle = f"cam{turn}", 0.5 * np.pi * turn + 0.3
            place = [10.0 * np.cos(angle), 10.0 * np.sin(angle), 3.0]
            cameras[name] = look_at_camera(place, [0.0, 0.0, 1.0], 1000.0)
            seen = seen_by(cameras[name], joints, rng)
            change = spoil if name == BAD else others.get(name, lambda pixels: pixels)
            pixels[name] = change(seen)[:FRAMES]
        return import_people(tmp_path, cameras, pixels, FPS)

    return build


def run(match, joints):
    """What a run up to triangulation warns of, and its mean joint error [mm]."""
    project = match.parent / "project"
    said = succeed("run", match, "--project", project, "--until", "retriangulation")
    out = match.parent / "out"
    forms = ("--format", "joints", "--format", "coco")
    succeed("export", "match", *forms, "--project", project, "--out", out)
    off = apart_from(read_joints(out / "joints.npz"), joints[:FRAMES])
    return said.err + said.out, 1000.0 * np.nanmean(np.linalg.norm(off, axis=-1))


def test_a_knocked_camera_is_named_corrected_and_labelled_where_it_looks(imported, joints):
    match = imported(lambda pixels: np.concatenate([pixels[:60], pixels[60:] + KNOCK]))
    said, error = run(match, joints)
    assert "camera cam2 moves at frame 60, by 27 px" in said
    assert error < 11.5  # 10.5 mm; 10.3 without the knock
    opened = open_run(str(match.parent / "project"), "match")
    figures = opened.record.figures["triangulation/clip"]
    bad = {name: figures[f"unhealthy_share.cam{name}"] for name in range(4)}
    assert 0.4 < bad[2] == figures["unhealthy_share"] < 0.6
    assert max(bad[n] for n in (0, 1, 3)) < 0.05
    assert 55 <= figures["unhealthy_from_frame.cam2"] <= 65
    usability = opened.record.usability
    assert usability.verdict == "usable with reservations"
    assert any("camera cam2 moves at frame 60" in each for each in usability.reservations)
    after = judge_health(opened["retriangulation/clip"]["health"].values)
    assert (after > 1.0).mean() < 0.02  # corrected
    store = Store.open(match.parent / "project")
    (picture,) = health_picture(opened, open_match(store, "match"), "clip")
    assert "cam2 moves at frame 60, by 27 px" in picture.caption
    given = json.loads((match.parent / "poses/cam2.json").read_text())
    written = json.loads((match.parent / "out/cam2.json").read_text())["annotations"]
    for frame in (30, 100):
        seen, shown = (
            np.array([np.reshape(p["keypoints"], (17, 3)) for p in each if p["image_id"] == frame])
            for each in (given, written)
        )
        apart = np.linalg.norm(shown[:, None, :, :2] - seen[None, :, :, :2], axis=-1)
        assert apart.mean(axis=-1).min(axis=1).max() < 3.0


def test_a_zoom_is_told_and_hides_no_knock_of_another_camera(imported, joints):
    match = imported(
        lambda pixels: np.concatenate([pixels[:60], 1.2 * (pixels[60:] - MIDDLE) + MIDDLE]),
        cam0=lambda pixels: np.concatenate([pixels[:90], pixels[90:] + KNOCK]),
    )
    said, _ = run(match, joints)
    assert "camera cam2: it moves within the clip, near frame 60" in said
    assert "camera cam0 moves at frame 90" in said


def test_lost_frames_are_named_and_synchronized(imported, joints):
    match = imported(lambda pixels: np.concatenate([pixels[:60], pixels[64:]]))
    said, error = run(match, joints)
    assert "camera cam2: its images are 4.0 match frames later from frame 60 on" in said
    project = ("--project", match.parent / "project")
    applied = succeed("synchronize", match, "--apply", "--json", *project).json["applied"]
    assert list(applied) == [BAD]
    cameras = yaml.safe_load((match / "match.yaml").read_text())["cameras"]
    (before, first), (after, last) = cameras[2]["offset_frames"]
    assert (first, last, after) == (0, -4, before + 1)
    assert abs(after - 60) <= 5
    said, corrected = run(match, joints)
    assert "camera cam2" not in said
    assert corrected < 11.5 < error  # 10.5 and 36.8 mm
