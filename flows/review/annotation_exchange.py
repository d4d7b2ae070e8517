"""Export of detections to external annotation tools, and import of their changes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.keypoints import KeypointDetections
from data_contracts.review import Correction, Edit
from flows.reports.match_pictures import frame_picture
from flows.review.corrections import keep_edits, next_id
from flows.review.detections import detections_now
from flows.stage import Match
from worldpose.errors import UsageError
from worldpose.formats.annotations import Format, format_suffix, read_annotations, write_annotations
from worldpose.formats.annotations.annotated_images import SEEN, AnnotatedImage, AnnotatedPerson
from worldpose.review.detections import DETECTION_EDITS, Changes, find_changes, image_name
from worldpose.store.store import Store

EXPORTED: Final = "exported.json"
"""Record of the export, next to the annotation file; the import compares against it."""
PICTURES: Final = "pictures"
"""Folder of the images."""


@dataclass(frozen=True)
class Exported:
    """Content of an export.

    `unseen` images have no file, since the camera has no video of the frame.
    """

    annotations: Path
    pictures: int
    people: int
    unseen: int


def export_people(
    store: Store, match: Match, places: Sequence[tuple[str, int]], folder: Path, form: Format
) -> Exported:
    """Write detections and images for an annotation tool.

    Each place is a camera, or the clip of a broadcast camera, and a match frame. The folder is
    absent or empty, or UsageError; it receives labels.json or labels.xml, pictures/ and
    exported.json. InputError if the latest run has no detections there, or an image is damaged.
    """
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(
            str(folder),
            expected="an absent or empty folder",
            found="files",
            todo="Choose another folder: annotations are never overwritten.",
        )
    import cv2  # imported here: few commands write an image

    (folder / PICTURES).mkdir(parents=True)
    exported, unseen = [], 0
    for camera, frame in places:
        found = detections_now(store, match, camera, frame)
        name = f"{PICTURES}/{image_name(camera, frame)}"
        exported.append(_annotate_image(match, camera, found, name))
        picture = frame_picture(store, match, camera, frame)
        if picture is None or not cv2.imwrite(str(folder / name), picture[..., ::-1]):
            unseen += 1
    annotations = folder / f"labels{format_suffix(form)}"
    write_annotations(annotations, exported, form)
    write_annotations(folder / EXPORTED, exported)
    people = sum(len(picture.people) for picture in exported)
    return Exported(annotations, len(exported), people, unseen)


def import_people(
    store: Store,
    open_match: Callable[[], Match],
    file: Path,
    exported: Path,
    form: Format | None,
    *,
    who: str,
) -> tuple[Changes, list[Correction]]:
    """Import an annotation tool's changes as corrections, all or none; a repeated import adds none.

    `exported` is the record of the export; without a format, the content of the file tells it.
    StaleEditError if another person corrected the same detection in between, InputError if a change
    does not apply; no change is kept then.
    """
    changes = find_changes(
        read_annotations(exported, "coco"), read_annotations(file, form), str(file)
    )
    content = hashlib.sha256(exported.read_bytes() + file.read_bytes()).hexdigest()
    edits: dict[str, Edit] = {}
    journal = open_match().journal
    for number, edit in enumerate(changes.edits):
        digest = hashlib.sha256(f"{content} {number}".encode()).hexdigest()
        edits[next_id(journal, f"{edit.kind}.{digest[:12]}")] = edit  # one withdrawn is made again
    note = f"annotated in {file.name}, SHA-256 {hashlib.sha256(file.read_bytes()).hexdigest()}"
    return changes, keep_edits(store, open_match, edits, who=who, note=note) if edits else []


def _annotate_image(
    match: Match, camera: str, found: KeypointDetections, name: str
) -> AnnotatedImage:
    spec = match.folder.spec.filming_camera(camera)
    assert spec is not None  # it has detections
    corrected = {
        (correction.edit.frame, correction.edit.detection)
        for correction in match.corrections
        if isinstance(correction.edit, DETECTION_EDITS) and correction.edit.camera == camera
    }
    people = []
    for k in np.flatnonzero(np.isfinite(found.score[0])) if len(found.frame) else ():
        keypoints = found.keypoints[0, k].astype(np.float64)
        there = np.isfinite(keypoints).all(axis=1)
        sure = np.nan_to_num(found.confidence[0, k]) >= SEEN
        is_corrected = (int(found.frame[0]), int(k)) in corrected
        people.append(
            AnnotatedPerson(
                box=found.boxes[0, k].astype(np.float64),
                keypoints=np.where(there[:, None], keypoints, np.nan),
                visible=(np.where(sure, 2, 1) * there).astype(np.int8),
                detection=int(k),
                origin="corrected" if is_corrected else "automatic",
                score=float(found.score[0, k]),
            )
        )
    return AnnotatedImage(name, (spec.width, spec.height), tuple(people))
