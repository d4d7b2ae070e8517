"""People of MMPose's and Ultralytics' JSON as entries of COCO keypoint results.

MMPose's demo writes a mapping with `instance_info`, a list of `frame_id` and `instances`, and its
inferencer that list alone, or for an image the list of instances. An instance has `keypoints`, a
list of x, y, `keypoint_scores`, `bbox` (x0 y0 x1 y1 in a list) and `bbox_score`. Ultralytics'
`to_json` gives a list of people for each image: `keypoints` with lists x, y and visible, `box` with
x1, y1, x2, y2, and `confidence`; a file is the list of all images, in order.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Any

from worldpose.errors import InputError


def plain_entries(where: str, items: Iterable[Any]) -> Iterator[Any]:
    """Yield entries of COCO results as they are, those of other forms with frames as image ids.

    InputError if MMPose's first frame is neither 0 nor 1, or an entry has no frame.
    """
    first: int | None = None
    for index, item in enumerate(items):
        content = _parse(item)
        if isinstance(content, list):
            for person in content:
                yield _with_frame(where, index, person, index)
        elif isinstance(content, dict) and isinstance(content.get("instances"), list):
            frame = content.get("frame_id")
            first = frame if first is None and type(frame) is int else first
            if type(frame) is not int or first not in (0, 1):
                expected = "whole numbers that begin with 0 or 1, as MMPose counts the images"
                todo = "Export the poses of the whole video."
                raise InputError(
                    f"{where}: entry {index}, frame_id", expected, repr(frame)[:40], todo
                )
            for person in content["instances"]:
                yield _with_frame(where, index, person, frame - first)
        elif isinstance(content, dict) and "image_id" not in content and _is_other(content):
            expected = "the frame of each person"
            todo = (
                "Put one file for each image, such as cam01_000012.json, into a folder that "
                "is named after the camera."
            )
            raise InputError(f"{where}: entry {index}", expected, "people of one image", todo)
        else:
            yield item if not _is_nested(content) else {**content, **_flat(content)}


def _is_nested(person: Any) -> bool:  # noqa: ANN401
    """Return whether a person's points are a list of x, y, confidence for each."""
    given = person.get("keypoints") if isinstance(person, dict) else None
    if not isinstance(given, list) or not given:
        return False
    return all(isinstance(at, list) and len(at) == 3 for at in given)


def _flat(person: dict[str, Any]) -> dict[str, Any]:
    return {"keypoints": [value for at in person["keypoints"] for value in at]}


def _parse(item: Any) -> Any:  # noqa: ANN401
    """Return an entry; `to_json` gives text, which a list of texts holds."""
    if isinstance(item, str) and item.lstrip().startswith("["):
        try:
            return json.loads(item)
        except ValueError:
            return item
    return item


def _with_frame(where: str, index: int, person: Any, frame: int) -> dict[str, Any]:  # noqa: ANN401
    plain = plain_person(person)
    if plain is None:
        expected = "people with `keypoints`, as MMPose and Ultralytics write them"
        todo = "Export the results of a model of poses, not of boxes."
        raise InputError(f"{where}: entry {index}", expected, f"{person!r:.60}", todo)
    return {"image_id": frame, **plain}


def _is_other(person: dict[str, Any]) -> bool:
    given = person.get("keypoints")
    return isinstance(given, dict) or "keypoint_scores" in person


def plain_person(person: Any) -> dict[str, Any] | None:  # noqa: ANN401
    """Return `keypoints`, `bbox` and `score` of COCO results; None for another form.

    Lists of different lengths, and values of another type, stay for the reader to refuse.
    """
    if not isinstance(person, dict) or not _is_other(person):
        return _flat(person) if _is_nested(person) else None
    given = person.get("keypoints")
    if isinstance(given, dict):
        told = given.get("visible")
        rows = [given.get("x", []), given.get("y", []), [] if told is None else told]
        if not all(isinstance(row, list) for row in rows):
            return {"keypoints": given}
        if not rows[2]:
            rows[2] = [1.0] * len(rows[0])
        box = person.get("box")
        box = box if isinstance(box, dict) else {}
        corners: list[Any] = [box.get(key) for key in ("x1", "y1", "x2", "y2") if key in box]
        score = person.get("confidence")
    else:
        scores, given = person.get("keypoint_scores"), given or []
        pairs = all(isinstance(at, list) and len(at) == 2 for at in given)
        if not isinstance(scores, list) or not pairs:
            return {"keypoints": given}
        rows = [[at[0] for at in given], [at[1] for at in given], scores]
        corners = person.get("bbox") or []
        corners = corners[0] if corners and isinstance(corners[0], list) else corners
        score = person.get("bbox_score")
    if len({len(row) for row in rows}) > 1:
        lengths = " and ".join(str(len(row)) for row in rows)
        return {"keypoints": f"lists of {lengths} values of x, y and confidence"}
    if len(corners) == 4 and all(isinstance(value, int | float) for value in corners):
        corners = [corners[0], corners[1], corners[2] - corners[0], corners[3] - corners[1]]
    keypoints = [value for at in zip(*rows, strict=True) for value in at]
    return {"keypoints": keypoints, "bbox": corners or None, "score": score}
