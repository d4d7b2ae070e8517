"""Readers of methods' results: each yields the people of a clip.

HybrIK and 4DHumans give poses relative to the camera of each image; GLAMR, WHAM, GVHMR, TRAM,
PromptHMR, SLAHMR and released poses give them in a world. Each docstring states the layout as
written by the method's own code at that commit. A reader takes the path, what poses bodies, and the
video's width and height [px], and raises InputError if a file has another layout.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body.body_file import is_open_body
from worldpose.formats.archives import read_npz
from worldpose.formats.baselines.result import (
    MethodTrack,
    Part,
    Person,
    Poser,
    boxes_around,
    format_error,
    project_boxes,
    read_pickled,
)
from worldpose.formats.joints_file import read_poses
from worldpose.pickles import FILE_BYTES

Size = tuple[int, int]


def read_hybrik(path: Path, poser: Poser, _: Size) -> Iterator[Person]:
    """Yield the people of HybrIK's result, each frame in its camera's axes.

    The result is `pose.pkl` of several people, or `res.pk` of one person.

    NVlabs/GLAMR at commit 44f820c writes `pose.pkl` in pose_est/hybrik_demo/demo.py, which runs
    HybrIK for all tracked people. It has `smpl_pose_quat_wroot` (the elements of rotation
    matrices), `smpl_beta`, `root_trans`, `kp_2d` px and `frames`. jeffffffli/HybrIK at commit
    c281eee writes `res.pk` in scripts/demo_video.py. It has `pred_thetas` (n, 216) rotation
    matrices, `pred_betas`, `transl`, `bbox` x0 y0 x1 y1 px, and `img_path` numbered from 1.
    """
    content = read_pickled(path)
    if isinstance(content.value, dict) and "pred_thetas" in content.value:
        images = content["img_path"]
        names = [str(name) for name in images.value]
        numbers = [int(found[1]) - 1 for n in names if (found := re.search(r"(\d+)\.\w+$", n))]
        if len(numbers) < len(names):
            raise format_error(images.where, "images with a number", f"{names[:3]}")
        frames = Part(images.where, numbers).frames()
        parts = (content[name] for name in ("pred_thetas", "pred_betas", "transl"))
        boxes = content["bbox"].floats(len(frames), 4)
        yield Person(0, frames, poser.joints(_track(frames, *parts), "smpl"), boxes)
        return
    for number, person in content.by_person():
        frames, turns = person["frames"].frames(), person["smpl_pose_quat_wroot"]
        if turns.as_floats().shape[:1] == frames.shape:
            turns = Part(turns.where, turns.as_floats().reshape(len(frames), -1))
        track = _track(frames, turns, person["smpl_beta"], person["root_trans"])
        boxes = boxes_around(person["kp_2d"].floats(len(frames), None, 2))
        yield Person(number, frames, poser.joints(track, "smpl", "pelvis"), boxes)


def _track(frames: NDArray[np.int64], turns: Part, betas: Part, place: Part) -> MethodTrack:
    count = len(frames)
    matrices = turns.floats(count, 216).reshape(-1, 24, 3, 3)
    return MethodTrack.of_matrices(
        frames, matrices, place.floats(count, 3), betas.floats(count, None)
    )


_Row = tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def read_humans4d(path: Path, poser: Poser, _: Size) -> Iterator[Person]:
    """Yield the people of 4DHumans' result in the images with a detection.

    4DHumans (HMR2 with PHALP's tracks) writes `results/demo_<clip>.pkl`, with poses relative to the
    camera.

    The layout is that of brjathu/PHALP at commit 96f7e6c, phalp/trackers/PHALP.py (`track`),
    which shubham-goel/4D-Humans at commit 6ec7965, track.py, runs with HMR2: joblib's file of a
    dictionary by image, with lists over people: `tid`, `tracked_time` (0 if detected in this
    image), `bbox` x y width height px, `camera` (3,) m, `smpl` with `global_orient` (1, 3, 3),
    `body_pose` (23, 3, 3) and `betas` (10,); `time` counts the images from 0.
    """
    content = read_pickled(path)
    if not isinstance(content.value, dict):
        raise format_error(path, "a dictionary by image", f"a {type(content.value).__name__}")
    rows: dict[int, dict[int, _Row]] = {}
    for name, image in content.value.items():
        for number, row in _read_image(Part(f"{path}: {name}", image)):
            rows.setdefault(number, {})[row[0]] = row
    for number, found in sorted(rows.items()):
        frames, turns, betas, place, boxes = (
            np.array(part) for part in zip(*(found[frame] for frame in sorted(found)), strict=True)
        )
        track = MethodTrack.of_matrices(frames, turns, place, betas)
        yield Person(number, frames, poser.joints(track, "smpl"), boxes)


def _read_image(image: Part) -> Iterator[tuple[int, _Row]]:
    """Yield id and row of every person detected in one image."""
    frame, ages = image["time"].integer(), image["tracked_time"].value
    for place, person in enumerate(image["tid"].value):
        if ages[place]:
            continue
        body, box, camera = (
            Part(image[key].where, image[key].value[place]) for key in ("smpl", "bbox", "camera")
        )
        turns = [body["global_orient"].floats(3, 3)[None], body["body_pose"].floats(23, 3, 3)]
        x, y, width, height = box.floats(4)
        around = np.array([x, y, x + width, y + height])
        row = (frame, np.concatenate(turns), body["betas"].floats(10), camera.floats(3), around)
        yield Part(image.where, person).integer(), row


def read_glamr(path: Path, poser: Poser, _: Size) -> Iterator[Person]:
    """Yield the people of GLAMR's result, in the frames that contain them.

    The file is `grecon/<clip>_seed<n>.pkl`, a pickle of arrays by person, all in one world.

    The layout is that of NVlabs/GLAMR at commit 44f820c, global_recon/run_demo.py and
    global_recon/models/global_recon_model.py (`init_data`, `optimize`): `person_data[id]` with
    `smpl_orient_world` (T, 3), `smpl_pose` (T, 69), `smpl_beta`, `root_trans_world` (T, 3),
    where the pelvis is, `scale` or None, `exist_frames` (T,) and `kp_2d` (T, 26, 2) px, 0 where
    there is none.
    """
    for number, person in read_pickled(path)["person_data"].by_person():
        exists = person["exist_frames"].floats(None) > 0.5
        count, scale = len(exists), person["scale"]
        track = MethodTrack(
            frames=np.flatnonzero(exists),
            global_orient=person["smpl_orient_world"].floats(count, 3)[exists],
            body_pose=person["smpl_pose"].floats(count, 69)[exists],
            place=person["root_trans_world"].floats(count, 3)[exists],
            betas=person["smpl_beta"].floats(count, None)[exists],
            scale=None if scale.value is None else scale.floats(count)[exists],
        )
        joints = poser.joints(track, "smpl", "pelvis")
        points = person["kp_2d"].floats(count, None, 2)[exists]
        # Joints that HybrIK lacks, and people in frames without an image of them, are zeros.
        points = np.where((points == 0.0).all(-1, keepdims=True), np.nan, points)
        yield Person(number, track.frames, joints, boxes_around(points))


def read_wham(path: Path, poser: Poser, image_size: Size) -> Iterator[Person]:
    """Yield the people of WHAM's result, each in a world of its own.

    The file is `wham_output.pkl`, a joblib file by person.

    The layout is that of yohanshin/WHAM at commit 2b54f77, demo.py: `pose_world` and `pose` (n,
    72), `trans_world` and `trans` (n, 3), `betas` (n, 10), `frame_ids` (n,). `trans_world` is
    the mid-hip (lib/models/smpl.py, `get_output`), `trans` is SMPL's own in camera axes; the
    focal length is the image diagonal (lib/vis/run_vis.py). Every trajectory begins at its own
    origin, so only scores of single people are meaningful.
    """
    size = np.array(image_size, dtype=np.float64)
    focal = np.full(2, np.linalg.norm(size))
    for number, person in read_pickled(path).by_person():
        frames = person["frame_ids"].frames()
        count, tracks = len(frames), []
        for suffix in ("_world", ""):
            pose = person[f"pose{suffix}"].floats(count, 72)
            place = person[f"trans{suffix}"].floats(count, 3)
            betas = person["betas"].floats(count, None)
            tracks.append(MethodTrack(frames, pose[:, :3], pose[:, 3:], place, betas))
        joints = poser.joints(tracks[0], "smpl", "mid_hip")
        seen = poser.joints(tracks[1], "smpl")
        yield Person(number, frames, joints, project_boxes(seen, focal, size / 2.0))


def read_gvhmr(path: Path, poser: Poser, _: Size) -> Iterator[Person]:
    """Yield the people of GVHMR's results, one for each file in order of their names.

    The file `hmr4d_results.pt` is a torch file of one person; several people have a folder of such
    files, at any depth.

    The layout is that of zju3dv/GVHMR at commit 44fbc19, tools/demo/demo.py and
    hmr4d/model/gvhmr/gvhmr_pl_demo.py: `smpl_params_global` and `smpl_params_incam`, SMPL-X
    with `global_orient` (T, 3), `body_pose` (T, 63), `transl` (T, 3) and `betas` (T, 10), and
    `K_fullimg` (T, 3, 3) px. The method follows one person through the whole video, in a world
    that begins at that person.
    """
    files = [path] if path.is_file() else sorted(path.rglob("*.pt"))
    # The method keeps other torch files in preprocess/.
    files = [file for file in files if file.parent.name != "preprocess"]
    if not files:
        raise format_error(path, "hmr4d_results.pt, or a folder of such files", "none")
    for number, file in enumerate(files):
        content = read_pickled(file)
        tracks = []
        for name in ("global", "incam"):
            given = content[f"smpl_params_{name}"]
            place = given["transl"].floats(None, 3)
            turns = given["global_orient"].floats(len(place), 3)
            angles = given["body_pose"].floats(len(place), 63)
            tracks.append(MethodTrack(np.arange(len(place)), turns, angles, place))
        world, seen = tracks
        intrinsics = content["K_fullimg"].floats(len(seen.frames), 3, 3)
        joints, in_camera = poser.joints(world, "other"), poser.joints(seen, "other")
        focal, center = intrinsics[:, (0, 1), (0, 1)], intrinsics[:, :2, 2]
        yield Person(number, world.frames, joints, project_boxes(in_camera, focal, center))


def read_tram(path: Path, poser: Poser, _: Size) -> Iterator[Person]:
    """Yield the people of TRAM's result, all in one world.

    The video's folder has `camera.npy` and `hps/hps_track_<n>.npy`.

    The layout is that of yufu-wang/tram at commit 4861c11, scripts/estimate_camera.py,
    scripts/estimate_humans.py and lib/models/hmr_vimo.py: numpy files that hold a dictionary;
    of the camera `world_cam_R` (T, 3, 3), `world_cam_T` (T, 3), `img_focal` and `img_center`
    px; of a person torch tensors `pred_rotmat` (n, 24, 3, 3), `pred_shape` (n, 10),
    `pred_trans` (n, 1, 3) in camera axes and `frame` (n,). World points are `world_cam_R x +
    world_cam_T`, the shape is the mean over the frames (lib/pipeline/visualization.py).
    """
    files = {
        int(found[1]): file
        for file in (path / "hps").glob("hps_track_*.npy")
        if (found := re.search(r"(\d+)\.npy$", file.name))
    }
    if not files:
        raise format_error(path, "hps/hps_track_<n>.npy", "none")
    camera = read_pickled(path / "camera.npy")
    turns = camera["world_cam_R"].floats(None, 3, 3)
    shifts = camera["world_cam_T"].floats(len(turns), 3)
    focal, center = camera["img_focal"].floats(), camera["img_center"].floats(2)
    for number, file in sorted(files.items()):
        content = read_pickled(file)
        # A track consists of pieces, in temporal order.
        frames = content["frame"].frames()
        if frames[-1] >= len(turns):
            expected = f"frames below {len(turns)}, as the camera has"
            raise format_error(file, expected, f"{frames[-1]}")
        count = len(frames)
        matrices = content["pred_rotmat"].floats(count, 24, 3, 3)
        place = content["pred_trans"].floats(count, 3)
        betas = content["pred_shape"].floats(count, None).mean(0)
        joints = poser.joints(MethodTrack.of_matrices(frames, matrices, place, betas), "smpl")
        world = np.einsum("fab,fjb->fja", turns[frames], joints) + shifts[frames, None]
        yield Person(number, frames, world, project_boxes(joints, np.full(2, focal), center))


def read_prompthmr(path: Path, poser: Poser, _: Size) -> Iterator[Person]:
    """Yield the people of PromptHMR's result, all in one world.

    The file, or the one in the given folder, is `results.pkl` of joblib.

    The layout is that of yufu-wang/PromptHMR at commit ea85d0a, pipeline/pipeline.py and
    pipeline/world.py: `people[id]` with `frames` (n,), `bboxes` (n, 4) x0 y0 x1 y1 px and
    `smplx_world`, SMPL-X with `pose` (n, 165), `shape` and `trans` (n, 3); `camera.img_center`
    px is the principal point of the images, which the method downscales.
    """
    content = read_pickled(path / "results.pkl" if path.is_dir() else path)
    for number, person in content["people"].by_person():
        frames = person["frames"].frames()
        count = len(frames)
        pose = person["smplx_world"]["pose"].floats(count, 165)
        place = person["smplx_world"]["trans"].floats(count, 3)
        joints = poser.joints(MethodTrack(frames, pose[:, :3], pose[:, 3:66], place), "other")
        yield Person(number, frames, joints, person["bboxes"].floats(count, None)[:, :4])
    width, height = (2.0 * content["camera"]["img_center"].floats(2)).tolist()
    poser.image_size = (width, height)


def read_smpl(path: Path, poser: Poser, _: Size) -> Iterator[Person]:
    """Yield the people of an npz file with `betas`, `global_orient`, `body_pose` and `transl`.

    Persons come first, NaN where one is missing (docs/reference/formats.md); betas of another body
    model are not used.
    """
    poses, named = read_poses(path)
    own = named == poser.model.name and is_open_body(poser.model.name)
    same = named in (None, poser.model.name)
    for person in range(poses.batch_shape[0]):
        there = np.isfinite(poses.transl[person]).all(-1)
        if not there.any():
            continue
        one = poses[person, there]
        track = MethodTrack(
            np.flatnonzero(there), one.global_orient, one.body_pose, one.transl, one.betas
        )
        joints = poser.joints(track, "open" if own else "smpl" if same else "other")
        yield Person(person, track.frames, joints)


def read_slahmr(path: Path, poser: Poser, _: Size, phase: str) -> Iterator[Person]:
    """Yield the people of SLAHMR's runs, all in one world; a run has a folder at any depth.

    The layout is that of vye16/slahmr at commit 58518fe, slahmr/run_opt.py,
    slahmr/optim/optimizers.py (`save_results`), slahmr/optim/output.py and
    slahmr/optim/moving_scene.py: in each run's folder `track_info.json` with the tracks' `index`
    and `vis_mask` and the intervals of images, and for each phase
    `<phase>/<clip>_<iteration>_world_results.npz` with SMPL+H `root_orient` (B, T, 3),
    `pose_body` (B, T, 63), `trans` (B, T, 3), and `cam_R` (B, T, 3, 3), `cam_t` (B, T, 3) of
    x_cam = R x_world + t; `<clip>_cameras_<iteration>.json` has `intrinsics` (T, 4) fx fy cx cy px.

    The method moves every piece's world so that its first camera is near the origin, and scales its
    camera path. Pieces are joined at their cameras: the orientation of one SLAM run is common to
    all, and the centre of a piece's first camera is moved to the last one of the previous piece.

    Of a phase the last iteration is used. HuMoR, the motion prior, is used in `motion_chunks`, not
    yet in `smooth_fit`.
    """
    infos = sorted(path.rglob("track_info.json"))
    runs = sorted((_read_run(info, poser, phase) for info in infos), key=lambda run: run[0])
    if not runs:
        raise format_error(path, "track_info.json of a run", "no such file")
    pieces: dict[int, list[_Piece]] = {}
    last = None
    for _first, people, centers in runs:
        shift = np.zeros(3) if last is None else last - centers[0]
        last = centers[-1] + shift
        for person, (frames, joints, boxes) in people.items():
            pieces.setdefault(person, []).append((frames, joints + shift, boxes))
    for person, some in sorted(pieces.items()):
        frames, joints, boxes = (np.concatenate(arrays) for arrays in zip(*some, strict=True))
        # Where pieces overlap, the first one is used.
        frames, first = np.unique(frames, return_index=True)
        yield Person(person, frames, joints[first], boxes[first])
    poser.notes |= {"phase": phase, "pieces": str(len(runs))}


_Piece = tuple[NDArray[np.int64], Floats, Floats]


def _read_run(info: Path, poser: Poser, phase: str) -> tuple[int, dict[int, _Piece], Floats]:
    """Return first image, people by id, and camera centres."""
    content = _read_json(info)
    files = sorted((info.parent / phase).glob("*_world_results.npz"))
    if not files:
        raise format_error(info.parent / phase, "<clip>_<iteration>_world_results.npz", "none")
    arrays = read_npz(files[-1], FILE_BYTES)
    array_names = ("root_orient", "pose_body", "trans", "cam_R", "cam_t")
    if not {*array_names} <= {*arrays}:
        raise format_error(files[-1], f"the arrays {', '.join(array_names)}", ", ".join(arrays))
    where = str(files[-1])
    place = Part(f"{where}: trans", arrays["trans"]).floats(None, None, 3)
    count, length = place.shape[:2]
    tails = {"root_orient": (3,), "pose_body": (63,), "cam_R": (3, 3), "cam_t": (3,)}
    turns, pose, camera, shift = (
        Part(f"{where}: {name}", arrays[name][:, :length]).floats(count, length, *tail)
        for name, tail in tails.items()
    )
    focal, center = _read_intrinsics(files[-1], length)
    begin = int(content["meta"]["data_interval"].integers(2)[0])
    start = int(content["meta"]["seq_interval"].integers(2)[0])
    people: dict[int, _Piece] = {}
    for number, track in content["tracks"].by_person():
        row = track["index"].integer()
        mask = track["vis_mask"].floats(None) > 0.5
        if not mask.any():
            continue
        if row >= count:
            expected = f"tracks below {count}, as the results have"
            raise format_error(track.where, expected, f"{row}")
        # A track lasts from the first to the last image of its person, visible or not.
        seen = np.flatnonzero(mask) - start
        rows = np.arange(seen[0], min(seen[-1] + 1, length))
        body = MethodTrack(rows, turns[row, rows], pose[row, rows], place[row, rows])
        joints = poser.joints(body, "other")
        relative = np.einsum("fab,fjb->fja", camera[row, rows], joints) + shift[row, rows, None]
        boxes = project_boxes(relative, focal[rows], center[rows])
        people[number] = (begin + start + rows, joints, boxes)
    return begin + start, people, -np.einsum("fba,fb->fa", camera[0], shift[0])


def _read_intrinsics(results: Path, length: int) -> tuple[Floats, Floats]:
    """Return focal lengths and principal points (images, 2) [px] for a results file."""
    iteration = results.name.split("_")[-3]
    files = sorted(results.parent.glob(f"*_cameras_{iteration}.json"))
    if not files:
        raise format_error(results.parent, f"<clip>_cameras_{iteration}.json", "none")
    numbers = _read_json(files[0])["intrinsics"].floats(None, 4)
    if len(numbers) < length:
        raise format_error(files[0], f"intrinsics of {length} images", f"{len(numbers)}")
    return numbers[:length, :2], numbers[:length, 2:]


def _read_json(path: Path) -> Part:
    try:
        return Part(str(path), json.loads(path.read_bytes()))
    except (OSError, ValueError, RecursionError) as error:
        raise format_error(path, "JSON", str(error)) from None
