"""A person adds a camera to a match, applies clock offsets, and corrects refused arrivals."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import page_client
import pytest
import yaml
from chromium import IN_BROWSER, drive
from command_line import TINY, succeed
from test_clock_offsets import shift
from test_create_match_in_browser import write_noise
from test_page_drafts import a_match

from flows.registering import open_for_review
from worldpose.store.store import Store

pytestmark = [*IN_BROWSER, pytest.mark.timeout(1500)]
SCRIPT = Path(__file__).with_name("versions_in_browser.mjs")
SERVER = """
import sys, threading, time
from pathlib import Path
from flows.service.inbox import take_in, watch_once
from flows.service.layout import served_state
from flows.web.access import access_for
from flows.web.intake import Intake
from flows.web.app import serve
from worldpose.store.store import Store
place, port, token = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
store = Store.open(str(place / "project"))
state = served_state(store.url)
def watch():
    while True:
        if watch_once(state, place / "inbox", 1.0):
            take_in(store, state, place / "inbox", 1.0, lambda match, arrival: "")
        time.sleep(0.5)
threading.Thread(target=watch, daemon=True).start()
access = access_for("127.0.0.1", token=token, names=(), secure=False)
serve(str(place / "project"), access, host="127.0.0.1", port=port, tls=None,
      intake=Intake(place / "inbox", ()))
"""


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
    port = page_client.free_port()
    command = [sys.executable, "-c", SERVER, str(tmp_path), str(port), page_client.TOKEN]
    server = subprocess.Popen(command, env=os.environ)
    base = f"http://127.0.0.1:{port}"
    try:
        page_client.wait_until_up(base)
        task = {"base": base, "token": page_client.TOKEN, "match": TINY}
        task["damaged"] = str(inbox / "cup" / "match.yaml")
        seen = drive(SCRIPT, {**task, "video": str(tmp_path / "roof.mp4")}, tmp_path, 1200)
    finally:
        server.kill()
        server.wait()
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
