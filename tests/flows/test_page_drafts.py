"""People create a match on the pages: uploads, picked videos, the form, and the inbox."""

import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction

import av
import cv2
import numpy as np
import page_client
import pytest

from flows.layers import write_layer
from flows.service.inbox import entries, fingerprint_of, missing_of, watch_once
from flows.service.layout import served_state
from flows.web.access import access_for
from flows.web.app import create_app
from flows.web.draft_folder import SPARE_BYTES, _doubt_detector
from flows.web.guard import CHUNK_BYTES
from flows.web.intake import Intake
from worldpose.ingest.match_folder import read_match
from worldpose.store.store import Store

DRAFTS = "/api/drafts"
SIZE, FPS, FRAMES = (96, 64), 25, 12


def open_pages(place, who="Ada"):
    """A browser at a server that has just started."""
    access = access_for("127.0.0.1", token=page_client.TOKEN, names=(), secure=False)
    intake = Intake(place / "inbox", (place / "videos",))
    return page_client.log_in(create_app(str(place / "project"), access, intake), who)


def put(browser, draft, file, offset, chunk):
    path = f"{DRAFTS}/{draft}/files/{file}/bytes?offset={offset}"
    return browser.put(path, content=chunk, headers={"content-type": "application/octet-stream"})


def begin(browser, file):
    """A new draft with one file that is to be uploaded."""
    draft = browser.post(DRAFTS, json={}).json()["id"]
    new = {"name": file.name, "size": file.stat().st_size, "modified_ms": 1}
    return draft, browser.post(f"{DRAFTS}/{draft}/files", json=new).json()["file"], new


def upload(browser, file):
    draft, file_id, _ = begin(browser, file)
    assert put(browser, draft, file_id, 0, file.read_bytes()).status_code == 200
    return draft, settle(browser, draft)


def settle(browser, draft, state="ready"):
    """The draft when all its files have a state."""
    for _ in range(300):
        view = browser.get(f"{DRAFTS}/{draft}").json()
        if all(file["state"] == state for file in view["files"]):
            return view
        time.sleep(0.05)
    raise AssertionError(view["files"])


def save(browser, view, content):
    return browser.post(
        f"{DRAFTS}/{view['id']}/form", json={"revision": view["revision"], "content": content}
    )


def a_match(file, **changes):
    camera = {"id": "near_left", "width": SIZE[0], "height": SIZE[1], "video": file}
    return {
        "contract": 1,
        "match_id": "final",
        "fps": FPS,
        "cameras": [camera | changes.pop("camera", {})],
        "clips": [{"id": "goal", "frame_count": FRAMES}],
        **changes,
    }


def test_drafts_share_the_disk_and_leave_the_last_gigabyte(place, footage, monkeypatch):
    ada, free = open_pages(place), SPARE_BYTES + 10 * footage.stat().st_size
    usage = shutil.disk_usage(place)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free))
    new = {"name": "a.mp4", "size": 4 * footage.stat().st_size, "modified_ms": 1}
    drafts = [ada.post(DRAFTS, json={}).json()["id"] for _ in range(6)]
    begin_all = [lambda at=at: ada.post(f"{DRAFTS}/{at}/files", json=new) for at in drafts]
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda begin_one: begin_one(), begin_all))
    assert sorted(answer.status_code for answer in answers) == [200] * 2 + [422] * 4
    at, took = next((at, it) for at, it in zip(drafts, answers, strict=True) if it.is_success)
    free = SPARE_BYTES + 5  # others wrote meanwhile
    answer = put(ada, at, took.json()["file"], 0, footage.read_bytes())
    assert answer.status_code == 422
    assert "free disk space" in answer.json()["error"]


def test_an_uploaded_match_arrives_whole(place, footage):
    ada = open_pages(place)
    draft, view = upload(ada, footage)
    (file,) = view["files"]
    assert (file["name"], file["width"], file["height"]) == ("videos/near_left.mp4", *SIZE)
    assert (file["fps"], file["frames"]) == (pytest.approx(FPS), FRAMES)
    assert not view["is_ready"]
    answer = ada.post(f"{DRAFTS}/{draft}/finish", json={})
    assert (answer.status_code, list(entries(place / "inbox"))) == (422, [])
    image = np.full((SIZE[1], SIZE[0], 3), 90, dtype=np.uint8)
    add(ada, draft, "near left.png", cv2.imencode(".png", image)[1].tobytes())
    _, still = settle(ada, draft)["files"]
    assert (still["name"], still["width"], still["height"]) == ("stills/near_left.png", *SIZE)
    roster = [{"id": "kane", "name": "Harry Kane", "team": "England", "role": "player"}]
    view = save(ada, view, a_match(file["name"], roster=roster)).json()
    (problem,) = view["problems"]
    assert "near left.png belongs to no camera" in problem["message"]
    content = a_match(file["name"], camera={"still": still["name"]}, roster=roster)
    view = save(ada, view, content).json()
    assert (view["problems"], view["is_ready"]) == ([], True)
    answer = ada.post(f"{DRAFTS}/{draft}/finish", json={"priority": "urgent"})
    assert answer.json() == {"arrived": "urgent/final"}
    (arrived,) = entries(place / "inbox")
    assert (arrived.name, missing_of(arrived.path)) == ("urgent/final", "")
    assert fingerprint_of(arrived.path)  # no links, only plain files
    match = read_match(arrived.path)
    assert match.videos["near_left"].read_bytes() == footage.read_bytes()
    assert match.stills["near_left"].name == "near_left.png"
    assert [person.name for person in match.spec.roster] == ["Harry Kane"]
    assert ada.get(DRAFTS).json() == {"drafts": []}
    assert list((place / "inbox" / ".drafts").iterdir()) == []
    # It came in one step: the first scan takes it in.
    state = served_state(str(place / "project"))
    assert len(watch_once(state, place / "inbox", 30.0)) == 1


def test_an_upload_survives_a_reload_and_a_restart(place, footage):
    content = footage.read_bytes()
    draft, file, new = begin(ada := open_pages(place), footage)
    assert put(ada, draft, file, 0, content[:700]).json() == {"received": 700}
    ada = open_pages(place)  # another process with the same token would be no different
    again = ada.post(f"{DRAFTS}/{draft}/files", json=new).json()["file"]
    assert again == file
    # Sent again, or with a gap: not taken, and the browser learns where to continue.
    for offset in (0, 900):
        answer = put(ada, draft, file, offset, content[offset : offset + 10])
        assert (answer.status_code, answer.json()) == (409, {"received": 700})
    assert put(ada, draft, file, 700, content[700:] + b"more").status_code == 422
    assert put(ada, draft, file, 700, content[700:]).json() == {"received": len(content)}
    settle(ada, draft)
    whole = place / "inbox" / ".drafts" / draft / "match" / "videos" / "near_left.mp4"
    assert whole.read_bytes() == content
    # Another file of the same name is another file.
    other = ada.post(f"{DRAFTS}/{draft}/files", json={**new, "modified_ms": 2}).json()["file"]
    assert other != file


CONTRADICTIONS = [
    ({"camera": {"video": None}}, "file", "belongs to no camera"),
    ({"camera": {"width": 100}}, "cameras[0].video", "expected 100 x 64 px"),
    ({"fps": 60}, "cameras[0].video", "expected 60 frames per second"),
    ({"clips": [{"id": "goal", "first_frame": 900, "frame_count": 5}]}, "cameras", "900"),
    ({"camera": {"id": "goal"}}, "", "must differ"),
    ({"match_id": "taken"}, "match_id", "another match"),
    ({"match_id": "../final"}, "match_id", "letters"),
    ({"camera": {"video": "../../draft.json"}}, "file", "belongs to no camera"),
]


def test_what_contradicts_the_videos_is_said(place, footage):
    (place / "inbox" / "background" / "taken").mkdir(parents=True)
    ada = open_pages(place)
    draft, view = upload(ada, footage)
    for changes, place_of_it, message in CONTRADICTIONS:
        view = save(ada, view, a_match(view["files"][0]["name"], **changes)).json()
        first = view["problems"][0]
        assert first["place"].startswith(place_of_it)
        assert message in first["message"]
        assert str(place) not in first["message"]
        assert ada.post(f"{DRAFTS}/{draft}/finish", json={}).status_code == 422


def test_a_video_is_picked_from_a_named_folder(place, footage):
    recordings = place / "videos" / "day 1"
    (recordings / "private").mkdir(parents=True)
    shutil.copy(footage, recordings / "cam.mp4")
    (recordings / "notes.txt").write_text("no video")
    (recordings / "link.mp4").symlink_to(footage)
    (place / "videos" / "linked").symlink_to(recordings)
    ada = open_pages(place)
    assert ada.get("/api/inbox").json()["folders"] == [str(place / "videos")]
    found = ada.get(f"{DRAFTS}/videos?folder=0").json()
    assert (found["folders"], found["videos"]) == (["day 1"], [])
    found = ada.get(f"{DRAFTS}/videos?folder=0&path=day 1").json()
    assert found["folders"] == ["private"]
    assert found["videos"] == [{"name": "cam.mp4", "size": footage.stat().st_size}]
    draft = ada.post(DRAFTS, json={}).json()["id"]
    picked = ada.post(f"{DRAFTS}/{draft}/picks", json={"folder": 0, "path": "day 1/cam.mp4"})
    assert picked.status_code == 200
    view = settle(ada, draft)
    assert view["files"][0]["frames"] == FRAMES
    view = save(ada, view, a_match(view["files"][0]["name"])).json()
    assert ada.post(f"{DRAFTS}/{draft}/finish", json={}).json() == {"arrived": "final"}
    copied = place / "inbox" / "final" / "videos" / "cam.mp4"
    assert (recordings / "cam.mp4").read_bytes() == footage.read_bytes()
    assert not copied.is_symlink() and not copied.samefile(recordings / "cam.mp4")


def add(browser, draft, name, content):
    """Upload a file; return its id."""
    new = {"name": name, "size": len(content)}
    file_id = browser.post(f"{DRAFTS}/{draft}/files", json=new).json()["file"]
    assert put(browser, draft, file_id, 0, content).status_code == 200
    return file_id


CALIBRATION = b"""
[cam_0]
name = "near_left"
size = [192, 128]
matrix = [[200.0, 0.0, 96.0], [0.0, 200.0, 64.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [-1.8, 0.0, 0.0]
translation = [0.0, 1.0, 20.0]
"""
CLICKS = b"""<annotations><image id="0" name="0.jpg" width="96" height="64">
<points label="center_mark" points="40.00,30.00"></points></image></annotations>"""
PERSON = {"image_id": 3, "category_id": 1, "score": 0.9, "keypoints": [20, 30, 0.8] * 17}
POSES = json.dumps([PERSON]).encode()


def test_files_of_other_tools_become_calibration_clicks_and_poses(place, footage):
    ada = open_pages(place)
    draft, view = upload(ada, footage)
    add(ada, draft, "Near_left clicks.xml", CLICKS)
    poses = add(ada, draft, "near_left.poses.json", POSES)
    stray = add(ada, draft, "poses.json", POSES)
    content = a_match(view["files"][0]["name"])
    view = save(ada, settle(ada, draft), content).json()
    (problem,) = view["problems"]
    assert "poses.json: expected a calibration or clicks" in problem["message"]
    assert "2D poses of an unknown camera" in problem["message"]
    view = ada.post(f"{DRAFTS}/{draft}/files/{stray}/removal", json={}).json()
    assert (view["problems"], view["is_ready"]) == ([], True)
    assert view["notes"] == [
        "Near_left_clicks.xml: 1 clicks in near_left",
        "near_left.poses.json: 2D poses of near_left",
    ]
    # A calibration in images of twice the size is scaled; people of one place give it no unit.
    ada.post(f"{DRAFTS}/{draft}/files/{poses}/removal", json={})
    add(ada, draft, "Scene.toml", CALIBRATION)
    view = ada.get(f"{DRAFTS}/{draft}").json()
    assert view["problems"] == []
    assert "scaled by 0.5" in " ".join(view["notes"])
    assert view["files"][-1]["calibrates"] == ["near_left"]
    assert str(place) not in str(view["notes"]) and "--" not in str(view["notes"])
    ada.post(f"{DRAFTS}/{draft}/finish", json={})
    match = read_match(place / "inbox" / "final")
    assert match.calibrations["near_left"].focal_px == (100.0, 100.0)
    assert match.clicked["near_left"].points[0].xy == (39.5, 29.5)  # the image begins at a corner
    assert not (place / "inbox" / "final" / "given").exists()
    # In a laboratory, people are taller than the bundled nets know.
    store = Store.open(str(place / "project"))
    lab = replace(match, spec=match.spec.model_copy(update={"pitch": "none"}))
    (said,) = _doubt_detector(store, lab)
    assert "28 to 160 px" in said and said.startswith("warning: no 2D poses of ")
    assert _doubt_detector(store, match) == []
    write_layer(store, "project", {"detection.detector": "onnx:/x.onnx"})
    assert _doubt_detector(store, lab) == []


def test_frames_are_counted_by_the_clock_of_the_camera(place, tmp_path):
    """A recorder left out frames 4 to 7: frame 9 stays frame 9, and 5 shows the nearest image."""
    file, levels = tmp_path / "camera.mp4", [0, 1, 2, 3, *range(8, 12)]
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height = SIZE
        for level in levels:
            image = np.full((SIZE[1], SIZE[0], 3), 20 * level, dtype=np.uint8)
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = level, Fraction(1, FPS)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    draft, view = upload(ada := open_pages(place), file)
    path = f"{DRAFTS}/{draft}/files/{view['files'][0]['id']}/frames"
    assert view["files"][0]["seconds"] == pytest.approx(11 / FPS)
    for number, fps, level in ((9, FPS, 9), (5, FPS, 3), (7, FPS, 8), (18, 2 * FPS, 9)):
        answer = ada.get(f"{path}/{number}?fps={fps}")
        shown = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
        assert shown.mean() == pytest.approx(20 * level, abs=5), number
    for wrong in (f"12?fps={FPS}", "0?fps=0", "0?fps=nan", "1?fps=inf"):
        assert ada.get(f"{path}/{wrong}").status_code == 422, wrong


def test_a_form_that_another_person_changed_is_not_finished_unseen(place, footage):
    draft, view = upload(ada := open_pages(place), footage)
    seen = save(ada, view, a_match(view["files"][0]["name"])).json()["revision"]
    save(ada, ada.get(f"{DRAFTS}/{draft}").json(), a_match(view["files"][0]["name"], match_id="x"))
    answer = ada.post(f"{DRAFTS}/{draft}/finish", json={"revision": seen})
    assert (answer.status_code, answer.json()["detail"][:12]) == (409, "another page")
    add(ada, draft, "pitch.json", b"{}")  # a file is no other form
    answer = ada.post(f"{DRAFTS}/{draft}/finish", json={"revision": seen + 1})
    assert answer.json() == {"arrived": "x"}


def test_an_interrupted_copy_continues_after_a_restart(place, footage):
    shutil.copy(footage, place / "videos" / "cam.mp4")
    ada = open_pages(place)
    draft = ada.post(DRAFTS, json={}).json()["id"]
    ada.post(f"{DRAFTS}/{draft}/picks", json={"folder": 0, "path": "cam.mp4"})
    view = settle(ada, draft)
    folder = place / "inbox" / ".drafts" / draft
    whole, part = folder / "match" / "videos" / "cam.mp4", folder / "parts" / view["files"][0]["id"]
    whole.rename(part)
    os.truncate(part, 1000)  # as if the process had been killed there
    settle(open_pages(place), draft)
    assert whole.read_bytes() == footage.read_bytes()
    # A source that has changed since is not mixed with what was copied before.
    whole.rename(part)
    os.truncate(part, 1000)
    os.utime(place / "videos" / "cam.mp4", (1, 1))
    view = settle(open_pages(place), draft, "broken")
    assert "changed" in view["files"][0]["problem"]


OUTSIDE = """
../secret.mp4 /etc/passwd a/../../secret.mp4 link.mp4 linked/secret.mp4 pipe.mp4 . a//b.mp4
notes.txt none.mp4 nul\0.mp4
"""


def test_no_path_leads_out_of_a_named_folder(place, footage):
    shutil.copy(footage, place / "secret.mp4")
    videos = place / "videos"
    (videos / "link.mp4").symlink_to(place / "secret.mp4")
    (videos / "linked").symlink_to(place)
    os.mkfifo(videos / "pipe.mp4")
    (videos / "day.mp4").mkdir()
    (videos / "notes.txt").write_text("text")
    ada = open_pages(place)
    draft = ada.post(DRAFTS, json={}).json()["id"]
    picks = [(0, "day.mp4"), (0, ""), (1, "a.mp4"), (-1, "a.mp4")]
    for folder, path in [*picks, *((0, path) for path in OUTSIDE.split())]:
        answer = ada.post(f"{DRAFTS}/{draft}/picks", json={"folder": folder, "path": path})
        assert answer.status_code == 422, path
    for path in OUTSIDE.split():
        assert ada.get(f"{DRAFTS}/videos", params={"folder": 0, "path": path}).status_code == 422
    assert ada.get(f"{DRAFTS}/videos?folder=0&path=linked").status_code == 422
    assert ada.get(f"{DRAFTS}/{draft}").json()["files"] == []


NAMES = {
    "../../match.yaml.mp4": "videos/match.yaml.mp4",
    "C:\\recordings\\Kamera 1 ü.MOV": "videos/Kamera_1.mov",
    "....mp4": "videos/video.mp4",
    "calibration.toml": "calibration.toml",
}


def test_names_from_a_browser_are_safe_paths_and_what_no_match_needs_is_refused(place):
    ada = open_pages(place)
    draft = ada.post(DRAFTS, json={}).json()["id"]
    for name in NAMES:
        new = {"name": name, "size": len(CALIBRATION), "modified_ms": 0}
        assert ada.post(f"{DRAFTS}/{draft}/files", json=new).status_code == 200
    files = ada.get(f"{DRAFTS}/{draft}").json()["files"]
    assert [file["name"] for file in files] == [*NAMES.values()]
    put(ada, draft, files[-1]["id"], 0, CALIBRATION)
    cameras = ada.get(f"{DRAFTS}/{draft}").json()["files"][-1]["cameras"]
    assert cameras == {"near_left": [192, 128]}  # the page proposes them
    sizes = [("a.mp4", 0), ("a.mp4", 1 << 52), ("a.mp4", -1), ("match.yaml", 3), ("run.sh", 3)]
    for name, size in sizes:
        new = {"name": name, "size": size}
        assert ada.post(f"{DRAFTS}/{draft}/files", json=new).status_code == 422
    assert "queue" not in ada.get(f"{DRAFTS}/zzz").text  # no page is called so
    for other in ("..", "%2e%2e", "0123456789abcdef", "x" * 16):
        assert ada.get(f"{DRAFTS}/{other}").status_code in (404, 422)
        assert ada.post(f"{DRAFTS}/{other}/removal", json={}).status_code in (404, 405, 422)


def test_chunks_need_a_session_its_secret_bytes_and_a_limit(place, footage):
    ada = open_pages(place)
    draft, file, _ = begin(ada, footage)
    assert put(page_client.browser(ada.app), draft, file, 0, b"abc").status_code == 401
    path = f"{DRAFTS}/{draft}/files/{file}/bytes?offset=0"
    assert ada.put(path, json={"a": 1}).status_code == 415
    assert put(ada, draft, file, 0, bytes(CHUNK_BYTES + 1)).status_code == 413
    del ada.headers["x-form-secret"]
    assert put(ada, draft, file, 0, b"abc").status_code == 403


def test_a_kill_between_the_move_and_the_end_leaves_a_match_and_no_draft(place, footage):
    ada = open_pages(place)
    draft, view = upload(ada, footage)
    save(ada, view, a_match(view["files"][0]["name"]))
    folder = place / "inbox" / ".drafts" / draft
    kept = shutil.copytree(folder, place / "kept")
    ada.post(f"{DRAFTS}/{draft}/finish", json={})
    shutil.rmtree(kept / "match")
    shutil.copytree(kept, folder)  # the match has moved, the rest is still there
    text = (folder / "draft.json").read_text()
    done = text.replace('"finished_as": null', '"finished_as": "final"')
    (folder / "draft.json").write_text(done)
    assert ada.get(DRAFTS).json() == {"drafts": []}
    assert not folder.exists()
    assert (place / "inbox" / "final" / "match.yaml").exists()
