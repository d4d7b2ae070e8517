"""Pages add files to a match by its next version, and lead back from matches that were refused."""

import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from unittest.mock import Mock

import page_client
import pytest
import yaml
from command_line import TINY
from test_page_drafts import DRAFTS, FPS, FRAMES, SIZE, a_match, add, open_pages, save, settle

from data_contracts.operations import MatchSummary
from data_contracts.review import NamedTrack
from flows.match_state import match_state
from flows.registering import open_for_review, open_match
from flows.review.corrections import keep_edits
from flows.service.inbox import put_in, take_in, watch_once
from flows.service.layout import StateFolder, served_state
from flows.web.draft_folder import LINKED_BYTES, SPARE_BYTES
from flows.web.queue import _intake
from worldpose.errors import InputError
from worldpose.store.store import Store


def arrive(place, begun=None):
    """Take in what is complete in the inbox; return all arrivals by name."""
    store = Store.open(str(place / "project"))
    state = served_state(store.url)
    watch_once(state, place / "inbox", 0.0)
    take_in(store, state, place / "inbox", 0.0, lambda match, arrival: str(begun or ""))
    return state.arrivals()


def contents(folder):
    return {
        each.relative_to(folder): each.read_bytes() for each in folder.rglob("*") if each.is_file()
    }


@pytest.fixture
def final(place, footage):
    """The pages of a project with a match of one camera, and the folder of the match."""
    ada = open_pages(place)
    draft = ada.post(DRAFTS, json={}).json()["id"]
    add(ada, draft, footage.name, footage.read_bytes())
    view = settle(ada, draft)
    name = view["files"][0]["name"]
    save(ada, view, a_match(name, camera={"side": "near"}))
    assert ada.post(f"{DRAFTS}/{draft}/finish", json={}).status_code == 200
    assert arrive(place)["final"].state == "taken"
    return ada, place / "inbox" / "final"


def test_a_match_that_is_being_taken_in_waits_and_offers_no_run(place, final):
    store = Store.open(str(place / "project"))
    context = SimpleNamespace(store=store, registration=store.registration)
    state = served_state(store.url)
    summary = MatchSummary(match_id="final", kind="new", words="not run yet")
    assert _intake(context, summary) is None
    arrival = state.arrivals()["final"]
    state.write_arrival(arrival.model_copy(update={"state": "arriving"}))
    assert _intake(context, summary)["is_intake"]
    assert _intake(context, summary.model_copy(update={"kind": "ready"})) is None


def test_a_further_camera_makes_the_next_version_and_the_folder_before_stays(
    place, footage, final, monkeypatch
):
    ada, folder = final
    before = contents(folder)
    draft = ada.post(DRAFTS, json={"match": "final"}).json()["id"]
    view = settle(ada, draft)
    assert [file["name"] for file in view["files"]] == ["videos/near_left.mp4"]
    assert view["problems"][0]["message"].startswith("nothing has changed yet")
    add(ada, draft, "far.mp4", footage.read_bytes())
    add(ada, draft, "far.json", clicks_of("far"))
    view = settle(ada, draft)
    content = view["content"]
    assert "far.mp4 belongs to no camera" in view["problems"][0]["message"]
    camera = {"id": "far", "width": SIZE[0], "height": SIZE[1], "video": "videos/far.mp4"}
    view = save(ada, view, content | {"cameras": [*content["cameras"], camera]}).json()
    assert view["is_ready"], view["problems"]
    assert any(note.startswith("The next run begins") for note in view["notes"]), view["notes"]
    another = ada.post(DRAFTS, json={"match": "final"}).json()["id"]
    with monkeypatch.context() as full:  # of whom it is the next version is known nevertheless
        full.setattr(StateFolder, "write_arrival", Mock(side_effect=OSError(28, "full")))
        assert ada.post(f"{DRAFTS}/{draft}/finish", json={}).json() == {"arrived": "final.v2"}
    copied = shutil.copytree(place / "inbox" / "final.v2", place / "inbox" / "copied")
    arrivals = arrive(place)
    assert (arrivals["final.v2"].state, arrivals["copied"].replaces) == ("taken", None)
    shutil.rmtree(copied)
    match = open_for_review(Store.open(str(place / "project")), "final")
    assert match.folder.folder == place / "inbox" / "final.v2"
    assert sorted(match.folder.videos) == ["far", "near_left"]
    assert match.folder.clicked["far"].points[0].name == "center_mark"
    assert contents(folder) == before
    # Whoever began with the version before would drop these files again.
    message = settle(ada, another)["problems"][0]["message"]
    assert message.startswith("another person added files meanwhile")


def clicks_of(camera):
    image = {"id": 0, "file_name": f"{camera}.jpg", "width": SIZE[0], "height": SIZE[1]}
    keypoints = {"id": 1, "name": "mark", "keypoints": ["center_mark"]}
    shown = {"id": 1, "image_id": 0, "category_id": 1, "keypoints": [40, 30, 2]}
    content = {"images": [image], "categories": [keypoints], "annotations": [shown]}
    return json.dumps(content).encode()


def test_runs_and_names_outlast_the_next_version(project_copy, tiny):
    store = Store.open(str(project_copy))
    edits = {"name": NamedTrack(clip="clip", person=0, name="Ann")}
    keep_edits(store, lambda: open_match(store, TINY), edits, who="Ada", note="")
    inbox = project_copy / "inbox"
    inbox.mkdir()
    ada = page_client.log_in(page_client.served(project_copy), "Ada")
    draft = ada.post(DRAFTS, json={"match": TINY}).json()["id"]
    view = settle(ada, draft)
    camera = view["content"]["cameras"][0]["id"]
    kept = next(it for it in view["files"] if it["name"].startswith(f"detections/{camera}."))
    suffix = kept["name"].rpartition(".")[2]
    poses = next(tiny.glob(f"detections/{camera}.*")).read_bytes()
    add(ada, draft, f"{camera}.{suffix}", poses)
    message = settle(ada, draft)["problems"][0]["message"]
    assert f"no 2D poses of {camera} yet" in message  # nothing is replaced in silence
    for file in ada.get(f"{DRAFTS}/{draft}").json()["files"]:
        if file["name"].startswith("given/") or f"/{camera}." in file["name"]:
            ada.post(f"{DRAFTS}/{draft}/files/{file['id']}/removal", json={})
    view = settle(ada, draft)
    content = view["content"]
    content["cameras"] = [each for each in content["cameras"] if each["id"] != camera]
    view = save(ada, view, content).json()
    assert view["is_ready"], view["problems"]
    (said,) = (note for note in view["notes"] if note.startswith("The next run begins"))
    assert "begins with: find cameras that contradict the others. It computes" in said
    assert ", and keeps " in said and len(said) < 160
    truth = f"reference/cameras/{camera}.npz"
    assert f"{truth} is left out: there is no such camera" in view["notes"]
    ada.post(f"{DRAFTS}/{draft}/finish", json={})
    state = served_state(store.url)
    watch_once(state, inbox, 0.0)
    take_in(store, state, inbox, 0.0, lambda match, arrival: "")
    match = open_match(store, TINY)
    assert match.folder.folder.name == f"{TINY}.v2"
    assert (tiny / truth).exists() and not (match.folder.folder / truth).exists()
    assert len(store.runs(TINY)) == 1 and len(match.corrections) == 1
    assert match_state(store, match).name == "outdated"


def test_an_untouched_draft_is_no_change_where_match_yaml_names_no_video(place, footage):
    ada, folder = open_pages(place), cup(place)
    text = (folder / "match.yaml").read_text()
    (folder / "match.yaml").write_text(text.replace("  video: videos/near.mp4\n", ""))
    shutil.copy(footage, folder / "videos" / "near_left.mp4")
    assert arrive(place)["cup"].state == "taken"
    draft = ada.post(DRAFTS, json={"match": "cup"}).json()["id"]
    (problem,) = settle(ada, draft)["problems"]
    assert problem["message"].startswith("nothing has changed yet")


def test_a_match_whose_files_are_gone_is_no_draft(place, final):
    ada, folder = final
    for spoil, told in (
        (lambda: (folder / "notes").symlink_to(place / "nowhere"), "notes"),
        (lambda: folder.rename(place / "elsewhere"), "final"),
    ):
        spoil()
        answer = ada.post(DRAFTS, json={"match": "final"})
        assert answer.status_code == 422, answer.text
        assert f"{told}: expected a match folder" in answer.json()["error"]
    assert list((place / "inbox" / ".drafts").iterdir()) == []


def test_the_form_tells_the_broken_video_for_which_a_match_was_refused(place, footage):
    ada, folder = open_pages(place), cup(place)
    (folder / "videos" / "near.mp4").write_bytes(footage.read_bytes()[:300])
    assert arrive(place)["cup"].state == "refused"
    draft = ada.post(DRAFTS, json={"arrival": "cup"}).json()["id"]
    view = settle(ada, draft, "broken")
    (problem,) = view["problems"]
    assert problem["place"] == "cameras[0].video" and "near.mp4" in problem["message"]
    assert str(place) not in str(view)


def cup(place, video=None, **changes):
    """A match in the inbox, of one camera from the near side."""
    folder = place / "inbox" / "cup"
    (folder / "videos").mkdir(parents=True)
    about = {"match_id": "cup", "camera": {"side": "near"}, **changes}
    (folder / "match.yaml").write_text(yaml.safe_dump(a_match("videos/near.mp4", **about)))
    if video is not None:
        shutil.copy(video, folder / "videos" / "near.mp4")
    return folder


def test_a_refused_match_can_be_corrected_tried_again_or_removed(place, footage):
    ada = open_pages(place)
    cup(place, footage, fps=-25)
    assert arrive(place)["cup"].state == "refused"
    (shown,) = ada.get("/api/inbox").json()["arrivals"]
    assert "fps" in shown["reason"]
    # Try again: of what is still wrong, the reason comes again.
    assert ada.post("/api/inbox/again", json={"name": "cup"}).status_code == 200
    assert ada.get("/api/inbox").json()["arrivals"][0]["state"] == "arriving"
    watch_once(served_state(str(place / "project")), place / "inbox", 0.0)
    assert arrive(place)["cup"].state == "refused"
    # Correct it: the form has all that it says, and the folder that came stays as it is.
    draft = ada.post(DRAFTS, json={"arrival": "cup"}).json()["id"]
    view = settle(ada, draft)
    assert view["problems"][0]["place"] == "fps"
    assert save(ada, view, view["content"] | {"fps": FPS}).json()["is_ready"]
    assert ada.post(f"{DRAFTS}/{draft}/finish", json={}).json() == {"arrived": "cup"}
    assert arrive(place)["cup"].state == "taken"
    (aside,) = (place / "inbox" / ".removed").iterdir()
    assert yaml.safe_load((aside / "match.yaml").read_text())["fps"] == -25
    assert open_for_review(Store.open(str(place / "project")), "cup").folder.spec.fps == FPS


def test_a_match_taken_in_while_it_is_corrected_keeps_its_folder(place, footage):
    ada, folder = open_pages(place), cup(place, footage, fps=-25)
    assert arrive(place)["cup"].state == "refused"
    draft = ada.post(DRAFTS, json={"arrival": "cup"}).json()["id"]
    view = settle(ada, draft)
    right = a_match("videos/near.mp4", match_id="cup", camera={"side": "near"})
    clips = [{"id": "goal", "frame_count": FRAMES - 1}]
    assert save(ada, view, right | {"match_id": "another", "clips": clips}).json()["is_ready"]
    (folder / "match.yaml").write_text(yaml.safe_dump(right))  # corrected where it is
    state, inbox = served_state(str(place / "project")), place / "inbox"
    watch_once(state, inbox, 0.0)
    late = shutil.copytree(folder, inbox / ".late")
    with pytest.raises(InputError, match="none any more"):  # before it is registered, and after
        put_in(state, inbox, late, "another", corrects=str(folder))
    assert arrive(place)["cup"].state == "taken"
    answer = ada.post(f"{DRAFTS}/{draft}/finish", json={})
    assert answer.status_code == 422 and "taken in meanwhile" in answer.json()["error"]
    assert (folder / "match.yaml").exists() and not (inbox / "another").exists()


def test_of_two_versions_at_the_same_time_one_arrives(place, final, monkeypatch):
    ada, _ = final
    finish = []
    for priority in ("urgent", "normal"):
        draft = ada.post(DRAFTS, json={"match": "final"}).json()["id"]
        view = settle(ada, draft)
        roster = [{"id": priority, "name": "Ann"}]
        assert save(ada, view, view["content"] | {"roster": roster}).json()["is_ready"]
        finish.append((f"{DRAFTS}/{draft}/finish", {"priority": priority}))
    read = StateFolder.arrivals

    def slowly(state):
        found = read(state)
        time.sleep(0.3)
        return found

    monkeypatch.setattr(StateFolder, "arrivals", slowly)
    with ThreadPoolExecutor(2) as threads:
        answers = list(threads.map(lambda it: ada.post(it[0], json=it[1]), finish))
    assert sorted(answer.status_code for answer in answers) == [200, 422]


def test_what_cannot_be_linked_has_to_fit_on_the_disk(place, final, monkeypatch):
    ada, folder = final
    (folder / "notes.bin").write_bytes(bytes(LINKED_BYTES))
    usage = shutil.disk_usage(place)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=SPARE_BYTES))
    assert ada.post(DRAFTS, json={"match": "final"}).status_code == 200
    monkeypatch.setattr(os, "link", Mock(side_effect=PermissionError))  # another user's files
    answer = ada.post(DRAFTS, json={"match": "final"})
    assert answer.status_code == 422 and "free disk space" in answer.json()["error"]
    # What a kill left half made is removed when it is old.
    half = [place / "inbox" / ".drafts" / name for name in ("0" * 16, "." + "1" * 16, "2" * 16)]
    for each in half:
        each.mkdir()
    for each in half[:2]:
        os.utime(each, (0, 0))
    assert len(ada.get(DRAFTS).json()["drafts"]) == 1
    assert [each.exists() for each in half] == [False, False, True]


def test_an_arrival_without_a_readable_match_yaml_is_a_form_with_its_files(place, footage):
    ada, folder = open_pages(place), cup(place, footage)
    for state in ("refused", "incomplete"):
        (folder / "match.yaml").write_text("{")
        if state == "incomplete":
            (folder / "match.yaml").unlink()
        assert arrive(place)["cup"].state == state
        draft = ada.post(DRAFTS, json={"arrival": "cup"}).json()["id"]
        assert [file["name"] for file in settle(ada, draft)["files"]] == ["videos/near.mp4"]
        assert ada.post(f"{DRAFTS}/{draft}/removal", json={}).status_code == 200
        assert ada.get(f"{DRAFTS}/{draft}").status_code == 422
    assert list((place / "inbox" / ".drafts").iterdir()) == []


def test_a_removed_arrival_is_kept_out_of_sight_and_one_with_a_link_is_no_draft(place):
    ada, folder = open_pages(place), cup(place)
    (folder / "videos" / "near.mp4").symlink_to("/etc/passwd")
    assert arrive(place)["cup"].state == "refused"
    answer = ada.post(DRAFTS, json={"arrival": "cup"})
    assert answer.status_code == 422 and "link" in answer.json()["error"]
    moved = ada.post("/api/inbox/removal", json={"name": "cup"}).json()["moved_to"]
    assert moved.startswith(str(place / "inbox" / ".removed"))
    assert arrive(place) == {} and not folder.exists()
    assert ada.post("/api/inbox/removal", json={"name": "cup"}).status_code == 422
