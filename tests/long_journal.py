"""A journal of many thousand corrections, as people leave it who worked on a match for weeks."""

from datetime import UTC, datetime, timedelta

from data_contracts.review import Correction, JournalEntry, MovedKeypoint, MovedPoint
from flows.registering import open_for_review
from worldpose.store.documents import record_checksum, seal

SESSION = 500
"""Corrections of one person in one session."""
POINTS_EVERY = 10
"""One in so many corrections moves a clicked point, the others move keypoints."""


def write_corrections(store, match_id, count):
    """Add `count` corrections to a match's journal, one entry each, without waiting for the disk
    after each."""
    match = open_for_review(store, match_id)
    camera, clicked = next(iter(match.folder.clicked.items()))
    point = clicked.points[0]
    at, began = point.xy, datetime.now(UTC) - timedelta(days=30)
    tip, last = match.journal.tip, match.journal.last
    folder = store.blobs.root / "reviews" / match_id
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(last + 1, last + count + 1):
        if number % POINTS_EVERY == 0:
            to = (point.xy[0] + (number % 7) * 0.125, point.xy[1] + (number % 11) * 0.125)
            edit = MovedPoint(camera=camera, marking=point.name, was=at, xy=to)
            at = to
        else:
            place = {"camera": camera, "frame": number % 5, "detection": number % 2}
            xy = (400.0 + number % 97, 300.0 + number % 89)
            edit = MovedKeypoint(joint="left_wrist", was=xy, xy=(xy[0] + 1.5, xy[1]), **place)
        correction = Correction(
            id=f"{edit.kind}.{number:012x}",
            match_id=match_id,
            edit=edit,
            who=("Ada", "Bob")[number // SESSION % 2],
            made_at=began + timedelta(seconds=number, hours=number // SESSION),
            based_on={f"static_calibration/{camera}": "0" * 32},
        )
        entry = JournalEntry(match_id=match_id, number=number, previous=tip, records=(correction,))
        (folder / f"{number:06d}.json").write_bytes(seal(entry))
        tip = record_checksum(entry)
