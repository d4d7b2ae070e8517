"""A person corrects a swap of two people and a wrong keypoint on the pages: in a real browser."""

import json
import os
from pathlib import Path

import numpy as np
import page_client
import pytest
from chromium import IN_BROWSER, drive
from command_line import TINY

from data_contracts.conventions import COCO17
from data_contracts.review import MergedTracks, MovedKeypoint, SplitTrack
from flows.registering import open_match
from flows.results.evaluation import score
from flows.review.corrections import keep_edits
from flows.review.detections import detections_now
from flows.review.identities import identities_now
from flows.running import RunRequest, run_match
from worldpose.store.store import Store

pytestmark = [*IN_BROWSER, pytest.mark.timeout(1800)]  # the run is done three times
SCRIPT = Path(__file__).with_name("mending_in_browser.mjs")
SHORTCUTS = Path(__file__).with_name("shortcuts_in_browser.mjs")


def say(store, *edits):
    given = {f"{edit.kind}.{os.urandom(6).hex()}": edit for edit in edits}
    keep_edits(store, lambda: open_match(store, TINY), given, who="Bob", note="wrong on purpose")


def swap(store):
    """Swap the tracks of two people from the middle of the clip on.

    Returns the two ids, the id of the second half of the first, and the frame of the swap.
    """
    found = identities_now(store, open_match(store, TINY), "clip").identities
    whole = [
        track.person
        for track in found.tracks
        if track.frames_seen == len(found.frame) and track.views >= 3
    ]
    one, other = whole[:2]
    middle = int(found.frame[len(found.frame) // 2])
    before = {*found.person.tolist()}
    ends = []
    for person in (one, other):
        say(store, SplitTrack(clip="clip", person=person, first_frame_of_new=middle))
        now = identities_now(store, open_match(store, TINY), "clip").identities.person.tolist()
        (new,) = {*now} - before
        before = {*now}
        ends.append(new)
    say(store, MergedTracks(clip="clip", kept=one, merged=ends[1]))
    return one, other, ends[0], middle


def misplace(store):
    """Move a keypoint 60 px in one of several cameras; return which one, and its old position."""
    found = identities_now(store, open_match(store, TINY), "clip").identities
    row = len(found.frame) // 3
    frame = int(found.frame[row])
    k = int((found.detection_index[row] >= 0).sum(axis=0).argmax())
    c = int(np.flatnonzero(found.detection_index[row, :, k] >= 0)[0])
    camera, detection = found.cameras[c], int(found.detection_index[row, c, k])
    seen = detections_now(store, open_match(store, TINY), camera, frame)
    joint = int(np.nanargmax(seen.confidence[0, detection, 5:])) + 5
    was = [float(value) for value in seen.keypoints[0, detection, joint]]
    step = 60.0 if was[0] < 960 else -60.0
    place = {"camera": camera, "frame": frame, "detection": detection, "joint": COCO17[joint]}
    say(store, MovedKeypoint(**place, was=tuple(was), xy=(was[0] + step, was[1])))
    return place, was


def ways(identities):
    """Return each person's detections in all cameras and frames, regardless of ids."""
    index = identities.detection_index
    return {index[:, :, k].tobytes() for k in range(index.shape[2]) if (index[:, :, k] >= 0).any()}


def figures(store, reference, run):
    found = score(TINY, str(reference), store.url, run_id=run).evaluation
    return {
        "switches": found.switches,
        "association": found.association_accuracy,
        "mpjpe_mm": found.mpjpe_mm,
    }


def test_a_swap_and_a_wrong_keypoint_are_mended_and_the_final_figures_improve(
    tiny, project_copy, tmp_path
):
    store = Store.open(str(project_copy))
    # The tracker's identities, which are correct.
    tracked = ways(identities_now(store, open_match(store, TINY), "clip").identities)
    one, other, tail, middle = swap(store)
    place, was = misplace(store)
    spoiled = run_match(store, open_match(store, TINY), RunRequest({}))
    assert spoiled.state == "complete"
    with page_client.serving(project_copy, tmp_path) as base:
        task = {
            "base": base,
            "token": page_client.TOKEN,
            "match": TINY,
            "swapped": [one, other, tail],
            "middle": middle,
            "keypoint": place,
            "patience": 1200,
        }
        seen = drive(SCRIPT, {**task, "mends": True}, tmp_path, 1500)
        # A run with gates applies the corrections.
        waits = run_match(store, open_match(store, TINY), RunRequest({}, gates="auto"))
        assert waits.state == "waiting"
        after = drive(SCRIPT, {**task, "mends": False}, tmp_path, 1500)
    assert after["states"][0] == "waiting"
    assert after["states"][-1] == "complete", after["states"]
    # While it was wrong, the other cameras said so; put where they expect it, they agree.
    assert seen["error"] > 20.0
    assert seen["mended"] < 5.0
    assert seen["curves"] >= 1
    match = open_match(store, TINY)
    mine = [each.edit for each in match.corrections if each.who == "Ada"]
    assert [edit.kind for edit in mine] == [
        "split_track",
        "merged_tracks",
        "merged_tracks",
        "moved_keypoint",
    ]
    # The page puts a keypoint where cameras of a few pixels' error expect it.
    assert np.linalg.norm(np.subtract(mine[-1].xy, was)) < 12.0
    found = identities_now(store, match, "clip").identities
    assert ways(found) == tracked
    wrong, right = (figures(store, tiny / "reference", run) for run in (spoiled.run_id, "latest"))
    print(json.dumps({"before": wrong, "after": right}))
    assert wrong["switches"] >= 2
    assert right["switches"] == 0
    assert right["association"] > wrong["association"]
    assert right["mpjpe_mm"] < wrong["mpjpe_mm"]


def test_what_is_typed_is_no_shortcut_and_every_correction_can_be_undone(project_copy, tmp_path):
    store = Store.open(str(project_copy))
    frames = identities_now(store, open_match(store, TINY), "clip").identities.frame
    with page_client.serving(project_copy, tmp_path) as base:
        task = {
            "base": base,
            "token": page_client.TOKEN,
            "match": TINY,
            "middle": int(frames[len(frames) // 2]),
        }
        seen = drive(SHORTCUTS, task, tmp_path, 600)
        first, number = store.run(TINY), store.reserve_run(TINY)
        kept = {name: key for name, key in first.results.items() if name.startswith("ingest")}
        failed = {"run_id": number, "parent": first.run_id, "results": kept, "state": "failed"}
        store.finish_run(first.model_copy(update=failed))
        earlier = drive(SHORTCUTS, {**task, "later": True}, tmp_path, 600)
    assert seen["afterHelp"] == seen["undone"] == seen["unsplit"] == []
    assert seen["names"] == [[["named_track", 1]]] * 2
    assert (seen["before"], seen["named"]) == (1, 1)
    assert seen["button"].startswith("Run again, about ")
    because = "out of date because of 1 correction"
    assert [seen[name].strip().lower() for name in ("words", "home", "status")] == [because] * 3
    assert {name: value for name, value in seen.items() if "overflow" in name and value} == {}
    later = "These are results of run 0001. The later run 0002 failed and has no people."
    assert (earlier["later"], earlier["now"], earlier["links"]) == (later, 1, 1)
