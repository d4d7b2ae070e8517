"""2D poses and calibrations as other programs write them, with their usual peculiarities."""

import json
import re

import numpy as np

from data_contracts.conventions import COCO17
from worldpose.body.keypoints import BODY25

from .kinds import FILES, kinds


def frames_of(results):
    """The people of every frame from 0 on."""
    count = 1 + max((each["image_id"] for each in results), default=0)
    return [[each for each in results if each["image_id"] == n] for n in range(count)]


def points(result):
    return np.reshape(result["keypoints"], (-1, 3))


def with_points(result, changed, **more):
    return result | {"keypoints": np.asarray(changed, float).ravel().tolist()} | more


def mmpose(results, first=1):
    entries = [
        {
            "frame_id": first + n,
            "instances": [
                {
                    "keypoints": points(each)[:, :2].tolist(),
                    "keypoint_scores": points(each)[:, 2].tolist(),
                }
                for each in people
            ],
        }
        for n, people in enumerate(frames_of(results))
    ]
    names = {str(n): name for n, name in enumerate(COCO17)}
    return {"meta_info": {"keypoint_id2name": names}, "instance_info": entries}


def ultralytics(results):
    def person(each):
        x, y, visible = points(each).T.tolist()
        return {"name": "person", "keypoints": {"x": x, "y": y, "visible": visible}}

    return [[person(each) for each in people] for people in frames_of(results)]


def data_set(results, first_id=7001, names=COCO17, step=1):
    order = [list(COCO17).index(name) for name in names]
    people = [
        with_points(each, points(each)[order], image_id=first_id + step * each["image_id"])
        for each in results
    ]
    frames = sorted({each["image_id"] for each in results})
    images = [{"id": first_id + step * n, "file_name": f"a/f_{n:06d}.png"} for n in frames]
    return {
        "images": images,
        "annotations": people,
        "categories": [{"name": "person", "keypoints": list(names)}],
    }


def reorder(names):
    """In the order of a set, whose other points are missing."""

    def change(results):
        places = [list(COCO17).index(name) if name in COCO17 else -1 for name in names]
        blank = np.zeros((1, 3))
        return [with_points(e, np.concatenate([points(e), blank])[places]) for e in results]

    return change


def each_point(change):
    return lambda results: [with_points(each, change(points(each).copy())) for each in results]


def nobody(results):
    nan = [float("nan")] * 51
    return results + [{"image_id": n, "keypoints": nan} for n in (0, 1)]


def turned(p):
    return np.stack([1079.0 - p[:, 1], p[:, 0], p[:, 2]], axis=-1) * (p[:, 2:] > 0)


HUMAN36M = [0, 12, 14, 16, 11, 13, 15, 0, 5, 0, 1, 5, 7, 9, 6, 8, 10]
SURE = (1.0, 1.0, 1.3)
HARMLESS = {
    "as_mmpose": mmpose,
    "as_mmpose_from_0": lambda results: mmpose(results, 0),
    "as_ultralytics": ultralytics,
    "as_ultralytics_texts": lambda results: list(map(json.dumps, ultralytics(results))),
    "as_alphapose": lambda results: [
        each | {"image_id": f"{each['image_id']}.jpg", "score": 2.4} for each in results
    ],
    "image_ids_of_all_cameras": data_set,
    "image_ids_by_fives": lambda results: data_set(results, 1, step=5),
    "joints_named_in_reverse": lambda results: data_set(results, names=COCO17[::-1]),
    "joints_without_a_face": lambda results: data_set(results, names=COCO17[5:]),
    "as_body_25": reorder(BODY25),
    "as_halpe_26": reorder((*COCO17, *["-"] * 9)),
    "as_whole_body": reorder((*COCO17, *["-"] * 116)),
    "people_of_nan": nobody,
    "missing_joints_at_0_0": each_point(lambda p: p * (p[:, 2:] > 0)),
}
OTHERS = {
    "joints_of_human36m": each_point(lambda p: p[HUMAN36M]),
    "joints_of_mpi_in_reverse": each_point(lambda p: p[14::-1]),
    "scores_above_one": each_point(lambda p: p * SURE),
    "scores_of_100": each_point(lambda p: p * (1.0, 1.0, 100.0)),
    "shares_of_the_image": each_point(lambda p: p / (1920.0, 1080.0, 1.0)),
    "pictures_of_half_size": each_point(lambda p: p * (0.5, 0.5, 1.0)),
    "turned_pictures": each_point(turned),
    "frame_ids_from_5": lambda results: mmpose(results, 5),
    "image_ids_from_1": lambda results: [e | {"image_id": e["image_id"] + 1} for e in results],
    "mixed_numbers_of_joints": lambda results: [
        with_points(each, points(each)[: 17 - n % 2]) for n, each in enumerate(results)
    ],
    "one_image_of_ultralytics": lambda results: (ultralytics(results) or [[]])[0],
}
ONE_CAMERA = ("pictures_of_half_size", "turned_pictures", "image_ids_from_1")


def _write(draft, rng, how):
    """Write the 2D poses of all cameras, or of one, in a form."""
    name, change = how
    draft.coco = True
    chosen = sorted(draft.seen)
    if name in ONE_CAMERA and chosen:
        chosen = [str(rng.choice(chosen))]

    def strike(folder):
        for camera in chosen:
            file = folder / "detections" / f"{camera}.json"
            if file.is_file():
                file.write_text(json.dumps(change(json.loads(file.read_text()))))

    draft.after.append(strike)


for found, harmless in ((HARMLESS, True), (OTHERS, False)):
    named = {name: (name, change) for name, change in found.items()}
    kinds("forms", named, _write, phase=FILES, harmless=harmless)


def _toml(draft, rng, change):
    def strike(folder):
        file = folder / "calibration.toml"
        if file.is_file():
            file.write_text(change(file.read_text()))

    draft.after.append(strike)


kinds(
    "forms",
    {
        "decimal_commas": lambda text: re.sub(r"(\d)\.(\d)", r"\1,\2", text),
        "size_of_twice_the_middle": lambda text: re.sub(
            r"size = \[(\d+)", lambda m: f"size = [{int(m[1]) - 0.21}", text
        ),
        "a_table_of_settings": lambda text: "camera_count = 4\n[charuco]\ncolumns = 4\n" + text,
    },
    _toml,
    phase=FILES,
    base="given",
)
