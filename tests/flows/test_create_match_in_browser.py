"""A match is created and gets more files in a real browser, through a restart and refusals."""

import shutil
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import page_client
import pytest
import yaml
from chromium import IN_BROWSER, drive
from command_line import TINY, succeed
from test_clock_offsets import shift
from test_page_drafts import a_match

from flows.registering import open_for_review
from worldpose.ingest.match_folder import read_match
from worldpose.store.store import Store
from worldpose.video.files import write_video

pytestmark = [*IN_BROWSER, pytest.mark.timeout(1500)]
CREATING = Path(__file__).with_name("create_match_in_browser.mjs")
ADDING = Path(__file__).with_name("versions_in_browser.mjs")
SERVER = """
import sys
from pathlib import Path
from flows.web.access import access_for
from flows.web.intake import Intake
from flows.web.app import serve
place, port, token = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
access = access_for("127.0.0.1", token=token, names=(), secure=False)
intake = Intake(place / "inbox", tuple(map(Path, sys.argv[4:])))
serve(str(place / "project"), access, host="127.0.0.1", port=port, tls=None, intake=intake)
"""
WITH_INBOX = """
import sys, threading, time
from pathlib import Path
from flows.service.inbox import take_in, watch_once
from flows.service.layout import served_state
from worldpose.store.store import Store
place = Path(sys.argv[1])
store = Store.open(str(place / "project"))
state = served_state(store.url)
def watch():
    while True:
        if watch_once(state, place / "inbox", 1.0):
            take_in(store, state, place / "inbox", 1.0, lambda match, arrival: "")
        time.sleep(0.5)
threading.Thread(target=watch, daemon=True).start()
"""


def write_noise(file, frames):
    """A video that does not compress."""
    random = np.random.default_rng(0)
    images = (random.integers(0, 256, (180, 320, 3), dtype=np.uint8) for _ in range(frames))
    write_video(file, images, 25, quality=10)


@contextmanager
def serving(program, place, *folders):
    """The base address of a program that serves pages; its processes, and its command."""
    port = page_client.free_port()
    command = [sys.executable, "-c", program, str(place), str(port), page_client.TOKEN]
    command += map(str, folders)
    servers, base = [subprocess.Popen(command)], f"http://127.0.0.1:{port}"
    try:
        page_client.wait_until_up(base)
        yield base, servers, command
    finally:
        for server in servers:
            server.kill()
            server.wait()


def wait_for(file):
    while not file.exists():
        time.sleep(0.05)


def test_a_match_is_created_through_a_restart_and_a_reload(tmp_path):
    Store.create(str(tmp_path / "project"))
    (tmp_path / "inbox").mkdir()
    recordings = tmp_path / "videos" / "day 1"
    recordings.mkdir(parents=True)
    write_noise(tmp_path / "first.mp4", 60)
    write_noise(recordings / "second.mp4", 40)
    cv2.imwrite(str(tmp_path / "first.png"), np.full((180, 320, 3), 90, dtype=np.uint8))
    clicks = tmp_path / "second_keypoints.xml"
    clicks.write_text(
        '<annotations><image id="0" name="0.jpg" width="320" height="180">'
        '<points label="center_mark" points="40.00,30.00"></points></image></annotations>'
    )
    size, signal = (tmp_path / "first.mp4").stat().st_size, tmp_path / "signal"
    assert size > 2_000_000

    def restart(servers, command):
        wait_for(signal.with_suffix(".restart"))
        servers[0].kill()
        servers[0].wait()
        wait_for(signal.with_suffix(".seen"))
        servers.append(subprocess.Popen(command))
        signal.with_suffix(".restarted").touch()

    with serving(SERVER, tmp_path, tmp_path / "videos") as (base, *server):
        threading.Thread(target=restart, args=server, daemon=True).start()
        task = {"base": base, "token": page_client.TOKEN, "size": size, "signal": str(signal)}
        task |= {"video": str(tmp_path / "first.mp4"), "still": str(tmp_path / "first.png")}
        seen = drive(CREATING, task | {"clicks": str(clicks)}, tmp_path, 600)
    assert str(tmp_path / "inbox") in seen["empty"]
    assert "worldpose" not in seen["empty"].lower().replace(str(tmp_path).lower(), "")
    assert seen["restarted"]
    assert seen["kept"] >= 0.4 * size  # nothing that was sent before is sent again
    assert "letters, digits" in seen["message"]
    assert seen["refused"] == 0
    assert seen["name"] == "cup_final"  # a blank of a name is written as ids have it
    assert seen["close"].endswith("/8?fps=25&width=4096")
    losing = [text.split(":")[0] for text in seen["losing"]]
    assert losing == ['Line 2, "kane, Bob"', 'Line 1, "junk"']
    assert seen["pasted"] == ["2 added, 0 changed", "0 added, 1 changed"]
    assert (seen["again"], seen["offset"]) == (["cup_other", "25"], "second offset 4 frames")
    assert (seen["together"], seen["unsaved"]) == (["10", "16"], [False, False])
    assert [value for name, value in seen.items() if name.startswith("overflow")] == [0] * 5
    match = read_match(tmp_path / "inbox" / "cup_final")
    assert [camera.side for camera in match.spec.cameras] == ["far", None]
    assert match.to_click == ()  # people whom both cameras see tell the side of the second
    first, second = (match.videos[name].read_bytes() for name in ("first", "second"))
    assert first == (tmp_path / "first.mp4").read_bytes()
    assert second == (recordings / "second.mp4").read_bytes()
    assert match.clicked["second"].points[0].name == "center_mark"
    # Both show 37 frames: the second video has 40, and begins 3 late.
    assert (match.spec.fps, match.spec.clips[0].frame_count) == (25, 37)
    assert [camera.offset_frames for camera in match.spec.cameras] == [0, 3]
    assert match.stills["first"].read_bytes() == (tmp_path / "first.png").read_bytes()
    people = [(each.id, each.name, each.role) for each in match.spec.roster]
    kane, pickford = ("kane", "Harry Kane", "player"), ("pickford", "Jordan Pickford", "goalkeeper")
    assert people == [kane, pickford]


def refused(folder, video, **changes):
    (folder / "videos").mkdir(parents=True)
    shutil.copy(video, folder / "videos" / "near.mp4")
    camera = {"side": "near", "width": 320, "height": 180}
    content = a_match("videos/near.mp4", match_id=folder.name, camera=camera, **changes)
    (folder / "match.yaml").write_text(yaml.safe_dump(content))


def test_a_match_gets_a_camera_and_offsets_and_refused_ones_lead_back(server, tiny, tmp_path):
    folder, inbox = shift(tiny, tmp_path / "m"), tmp_path / "inbox"
    succeed("run", folder, "--until", "detection", "--project", tmp_path / "project")
    write_noise(tmp_path / "roof.mp4", 60)
    refused(inbox / "cup", tmp_path / "roof.mp4", fps=-25)
    refused(inbox / "old", tmp_path / "roof.mp4", roster=[{"id": "a/b", "name": "A"}])
    before = (folder / "match.yaml").read_bytes()
    with serving(WITH_INBOX + SERVER, tmp_path) as (base, *_):
        task = {"base": base, "token": page_client.TOKEN, "match": TINY}
        task |= {"damaged": str(inbox / "cup" / "match.yaml"), "video": str(tmp_path / "roof.mp4")}
        seen = drive(ADDING, task, tmp_path, 1200)
    assert "fps" in seen["reason"]
    assert "cam02" in seen["apply"]
    assert seen["title"] == f"Add files to {TINY}"
    assert seen["foreseen"].startswith("Before the next run, roof must be calibrated")
    assert [value for name, value in seen.items() if name.startswith("overflow")] == [0] * 18
    store = Store.open(str(tmp_path / "project"))
    match = open_for_review(store, TINY)
    assert match.folder.folder == inbox / f"{TINY}.v3"
    assert "roof" in match.folder.videos and len(store.runs(TINY)) == 1
    assert match.folder.spec.camera("cam02").offset_frames == 0
    assert (folder / "match.yaml").read_bytes() == before
    cup = open_for_review(store, "cup").folder
    assert (cup.folder.name, cup.spec.fps, seen["corrected"]) == ("cup.v2", 25, "25")
    assert not (inbox / "old").exists() and len([*(inbox / ".removed").iterdir()]) == 2
