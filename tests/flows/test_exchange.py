"""People go out to annotators and come back as corrections that say where they come from."""

import numpy as np
import pytest
from command_line import TINY

from flows.registering import open_match
from flows.review.annotation_exchange import export_people, import_people
from flows.review.detections import detections_now
from flows.review.edit_conflicts import StaleEditError
from flows.review.verdicts import withdraw
from worldpose.errors import UsageError
from worldpose.formats.annotations import FORMATS, read_annotations, write_annotations

PLACES = [("cam00", 3), ("cam01", 4)]


def test_what_people_annotate_elsewhere_is_corrected_here_once(store, tmp_path):
    form = FORMATS[0]  # test_formats has all
    match = open_match(store, TINY)
    out = tmp_path / "out"
    written = export_people(store, match, PLACES, out, form)
    exported = read_annotations(out / "exported.json")
    assert (written.pictures, written.unseen) == (2, 2)  # the match has no videos
    assert [picture.name for picture in exported] == [
        "pictures/cam00_000003.png",
        "pictures/cam01_000004.png",
    ]
    assert written.people == sum(len(picture.people) for picture in exported) > 2

    def take_in(file):
        opening = lambda: open_match(store, TINY)  # noqa: E731 - as the command does
        return import_people(store, opening, file, out / "exported.json", None, who="Ada")

    assert take_in(written.annotations)[1] == []  # nothing was changed
    first, second = exported
    gone, kept = first.people[0], first.people[1]
    joint = int(np.flatnonzero(kept.visible)[0])
    kept.keypoints[joint] += 3.25
    edited = tmp_path / f"back{written.annotations.suffix}"
    write_annotations(edited, [type(first)(first.name, first.size, first.people[1:]), second], form)
    _, corrections = take_in(edited)
    assert [each.edit.kind for each in corrections] == ["deleted_detection", "moved_keypoint"]
    assert corrections[0].edit.was == tuple(gone.box.tolist())
    assert all(
        each.who == "Ada" and f"annotated in {edited.name}" in each.note for each in corrections
    )
    now = detections_now(store, open_match(store, TINY), "cam00", 3)
    assert np.isnan(now.score[0, gone.detection])
    assert now.keypoints[0, kept.detection, joint].tolist() == pytest.approx(
        kept.keypoints[joint].tolist(),
        abs=1e-3,  # single precision of places up to 1920
    )
    # The same file again is the same corrections; another one of the same export comes too late.
    assert take_in(edited)[1] == corrections
    assert len(open_match(store, TINY).corrections) == 2
    # One that was undone is made again, once.
    withdraw(store, open_match(store, TINY), [corrections[0].id], who="Bob", why="")
    (again, _), second_time = take_in(edited)[1], take_in(edited)[1]
    assert again.id == f"{corrections[0].id}.2" and second_time[0] == again
    assert {*open_match(store, TINY).journal.standing} == {again.id, corrections[1].id}
    kept.keypoints[joint] += 1.0
    write_annotations(edited, [type(first)(first.name, first.size, first.people[1:]), second], form)
    with pytest.raises(StaleEditError):
        take_in(edited)
    again = export_people(store, open_match(store, TINY), PLACES, tmp_path / "again", "coco")
    origins = {
        person.detection: person.origin for person in read_annotations(again.annotations)[0].people
    }
    assert origins.pop(kept.detection) == "corrected"
    assert {*origins.values()} == {"automatic"}
    with pytest.raises(UsageError, match="absent or empty"):
        export_people(store, match, PLACES, out, form)
