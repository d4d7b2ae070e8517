"""Arrays of detections, and COCO results, that are not what readers expect."""

import io
import json
import zipfile

import numpy as np

from .camera_kinds import some
from .kinds import FILES, kinds
from .scene import npz_bytes


def _npz(draft, rng, make):
    name = some(draft, rng)

    def strike(folder):
        file = folder / "detections" / f"{name}.npz"
        if file.is_file():
            file.write_bytes(make({k: np.array(v) for k, v in draft.seen[name].items()}))

    draft.after.append(strike)


def _changed(name, change):
    return lambda arrays: npz_bytes({**arrays, name: change(arrays[name])})


def _member(name, content):
    return lambda arrays: npz_bytes({**arrays, name: content})


def _header(text, version=b"\x01\x00"):
    body = text.encode("latin-1")
    size = len(body).to_bytes(2 if version == b"\x01\x00" else 4, "little")
    return b"\x93NUMPY" + version + size + body


def _objects():
    form = io.BytesIO()
    np.save(form, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return form.getvalue()


def _fortran(arrays):
    changed = {
        name: np.asfortranarray(values.astype("<i8" if name == "frame" else "<f4"))
        for name, values in arrays.items()
    }
    packed = io.BytesIO()
    np.savez(packed, **changed)
    return packed.getvalue()


def _named(arrays, names):
    content = npz_bytes(arrays)
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(packed, "w") as new:
        for info in old.infolist():
            for name in names(info.filename):
                new.writestr(name, old.read(info))
    return packed.getvalue()


kinds(
    "bytes",
    {
        "npz_in_fortran_order": _fortran,
        "npz_packed": lambda arrays: npz_bytes(arrays, zipfile.ZIP_DEFLATED),
    },
    _npz,
    phase=FILES,
    harmless=True,
)
kinds(
    "bytes",
    {
        "npz_of_doubles": _changed("keypoints", lambda a: np.ascontiguousarray(a, ">f8")),
        "npz_of_big_endian": _changed("keypoints", lambda a: np.ascontiguousarray(a, ">f4")),
        "npz_of_records": _changed("frame", lambda a: np.zeros(3, dtype=[("a", "<i4")])),
        "npz_of_objects": _member("keypoints", _objects()),
        "npz_without_joints": _changed("keypoints", lambda a: a[:, :, :13]),
        "npz_transposed": _changed("keypoints", lambda a: np.swapaxes(a, 0, 1)),
        "npz_of_one_frame_more": _changed("score", lambda a: np.concatenate([a, a[:1]])),
        "npz_member_missing": lambda arrays: npz_bytes(
            {k: v for k, v in arrays.items() if k != "score"}
        ),
        "npz_member_twice": lambda arrays: _named(arrays, lambda n: [n] * (1 + (n == "score.npy"))),
        "npz_member_without_data": _member(
            "score", _header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 3), }\n")
        ),
        "npz_of_huge_shape": _member(
            "score", _header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 10**12), }\n")
        ),
        "npz_with_a_program_for_header": _member(
            "score", _header("__import__('os').system('id')\n")
        ),
        "npz_of_deep_header": _member("score", _header("[" * 3000 + "]" * 3000)),
        "npz_bomb": lambda arrays: npz_bytes(
            {
                "frame": np.arange(20),
                **{
                    name: np.full((20, 20000, *shape), np.nan, "<f4")
                    for name, shape in (
                        ("keypoints", (17, 2)),
                        ("confidence", (17,)),
                        ("boxes", (4,)),
                        ("score", ()),
                    )
                },
            },
            zipfile.ZIP_DEFLATED,
        ),
        "npz_of_a_directory_that_lies": lambda arrays: npz_bytes(arrays).replace(
            b"PK\x01\x02", b"PK\x01\x03", 1
        ),
    },
    _npz,
    phase=FILES,
)


def _coco(draft, rng, change):
    draft.coco = True
    name = some(draft, rng)
    draft.truth = None

    def strike(folder):
        file = folder / "detections" / f"{name}.json"
        if file.is_file():
            content = json.loads(file.read_text())
            file.write_text(json.dumps(change(content)))

    draft.after.append(strike)


def _each(key, value):
    def change(results):
        for result in results:
            result[key] = value(result[key]) if callable(value) else value
        return results

    return change


def _first(key, value):
    def change(results):
        if results:
            results[0][key] = value
        return results

    return change


kinds(
    "bytes",
    {
        "coco_as_data_set": lambda r: {"images": [], "annotations": r},
        "coco_of_visibilities": _each(
            "keypoints", lambda k: [2 if i % 3 == 2 else v for i, v in enumerate(k)]
        ),
        "coco_of_percent": _each(
            "keypoints", lambda k: [v * 100 if i % 3 == 2 else v for i, v in enumerate(k)]
        ),
        "coco_of_13_joints": _each("keypoints", lambda k: k[:39]),
        "coco_of_named_images": _each("image_id", "000001.jpg"),
        "coco_of_fractional_images": _each("image_id", 1.5),
        "coco_of_one_image": _each("image_id", 3),
        "coco_of_nan": _first("keypoints", [float("nan")] * 51),
        "coco_of_text": _first("keypoints", ["1"] * 51),
        "coco_of_negative_box": _first("bbox", [10, 10, -5, -5]),
        "coco_of_text_score": _first("score", "0.9"),
        "coco_of_2000_people": lambda r: [{**each, "image_id": 0} for each in (r * 200)[:2000]],
    },
    _coco,
    phase=FILES,
)
