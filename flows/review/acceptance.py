"""Acceptance of a camera's detections: those still open, and those that a person accepted."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from datetime import UTC, datetime

from data_contracts.review import Acceptance
from flows.review.detections import results_of, stored_people
from flows.stage import Match
from worldpose.review import say
from worldpose.review.detections import DETECTION_EDITS
from worldpose.review.evidence import OpenDetections, open_detections
from worldpose.store import Store


def left_to_look_at(store: Store, match: Match, camera: str) -> list[OpenDetections]:
    """Return the detections that no person has accepted or corrected, by result of the camera.

    Args:
        store: the store.
        match: the match with its journal.
        camera: a static camera, or the clip of a broadcast camera.

    Raises:
        InputError: the latest run has no detections of this camera.
    """
    said = [each for each in match.journal.records if isinstance(each, Acceptance)]
    edits = [
        correction.edit
        for correction in match.corrections
        if isinstance(correction.edit, DETECTION_EDITS) and correction.edit.camera == camera
    ]
    found = []
    for name in results_of(store, match, camera):
        result, plain = stored_people(store, match, name)
        accepted = [each for each in said if each.results.get(name) == plain]
        found.append(
            open_detections(result["frame"].values, result["score"].values, accepted, edits)
        )
    return found


def accept(
    store: Store,
    match: Match,
    camera: str,
    *,
    at_least: float | None,
    people: Sequence[tuple[int, int]],
    who: str,
) -> Acceptance:
    """Record in the journal that a person accepted detections.

    Args:
        store: the store that holds the journal.
        match: the match.
        camera: a static camera, or the clip of a broadcast camera.
        at_least: accept every detection with at least this score [1]; None = only those in
            `people`.
        people: match frame, and index among the detections of the frame.
        who: name of the reviewer.

    Raises:
        InputError: the latest run has no detections of this camera.
    """
    names = results_of(store, match, camera)
    acceptance = Acceptance(
        id=f"acceptance.{uuid.uuid4().hex[:12]}",
        match_id=match.match_id,
        results={name: stored_people(store, match, name)[1] for name in names},
        at_least=at_least,
        people=tuple(people),
        who=who,
        accepted_at=datetime.now(UTC),
    )
    say(store, match.match_id, lambda journal: [acceptance])
    return acceptance
