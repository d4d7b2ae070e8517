"""Methods with poses in a world: GLAMR, WHAM, GVHMR, TRAM, PromptHMR, SLAHMR, and released poses.

Each docstring states the layout as written by the method's own code at that commit.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worldpose.body.body_file import is_open_body
from worldpose.body.model import BodyModel
from worldpose.formats.archives import read_npz
from worldpose.formats.baselines.result import (
    MethodResult,
    MethodTrack,
    Part,
    Person,
    boxes_around,
    format_error,
    merge_people,
    pose_track,
    project_boxes,
    read_pickled,
    rotation_vectors,
)
from worldpose.formats.joints_file import read_poses
from worldpose.pickles import FILE_BYTES


def read_glamr(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of GLAMR's result, in the frames that contain them.

    The file is `grecon/<clip>_seed<n>.pkl`, a pickle of arrays by person, all in one world.

    The layout is that of NVlabs/GLAMR at commit 44f820c, global_recon/run_demo.py and
    global_recon/models/global_recon_model.py (`init_data`, `optimize`): `person_data[id]` with
    `smpl_orient_world` (T, 3), `smpl_pose` (T, 69), `smpl_beta`, `root_trans_world` (T, 3),
    where the pelvis is, `scale` or None, `exist_frames` (T,) and `kp_2d` (T, 26, 2) px, 0 where
    there is none.

    Args:
        path: the pickle.
        model: body model to pose.

    Raises:
        InputError: the file has another format.
    """
    people, used = [], ""
    for number, person in read_pickled(path)["person_data"].by_person():
        exists = person["exist_frames"].floats(None) > 0.5
        count = len(exists)
        scale = person["scale"]
        track = MethodTrack(
            frames=np.flatnonzero(exists),
            global_orient=person["smpl_orient_world"].floats(count, 3)[exists],
            body_pose=person["smpl_pose"].floats(count, 69)[exists],
            place=person["root_trans_world"].floats(count, 3)[exists],
            betas=person["smpl_beta"].floats(count, None)[exists],
            scale=None if scale.value is None else scale.floats(count)[exists],
        )
        joints, used = pose_track(track, model, "smpl", "pelvis")
        points = person["kp_2d"].floats(count, None, 2)[exists]
        # Joints that HybrIK lacks, and people in frames without an image of them, are zeros.
        points = np.where((points == 0.0).all(-1, keepdims=True), np.nan, points)
        people.append(Person(number, track.frames, joints, boxes_around(points)))
    return merge_people("shared", people, {"shape": used})


def read_wham(path: Path, model: BodyModel, image_size: tuple[int, int]) -> MethodResult:
    """Return the people of WHAM's result.

    The file is `wham_output.pkl`, a joblib file by person. Each person has a separate world.

    The layout is that of yohanshin/WHAM at commit 2b54f77, demo.py: `pose_world` and `pose` (n,
    72), `trans_world` and `trans` (n, 3), `betas` (n, 10), `frame_ids` (n,). `trans_world` is
    the mid-hip (lib/models/smpl.py, `get_output`), `trans` is SMPL's own in camera axes; the
    focal length is the image diagonal (lib/vis/run_vis.py). Every trajectory begins at its own
    origin, so only scores of single people are meaningful.

    Args:
        path: joblib's file.
        model: body model to pose.
        image_size: width and height of the video [px], which determine the focal length.

    Raises:
        InputError: the file has another format.
    """
    size = np.array(image_size, dtype=np.float64)
    focal = np.full(2, np.linalg.norm(size))
    people, used = [], ""
    for number, person in read_pickled(path).by_person():
        frames = person["frame_ids"].frames()
        joints, used = pose_track(
            _read_wham_track(person, frames, "_world"), model, "smpl", "mid_hip"
        )
        seen = pose_track(_read_wham_track(person, frames, ""), model, "smpl")[0]
        people.append(Person(number, frames, joints, project_boxes(seen, focal, size / 2.0)))
    return merge_people("own", people, {"shape": used})


def _read_wham_track(person: Part, frames: NDArray[np.int64], suffix: str) -> MethodTrack:
    count = len(frames)
    pose = person[f"pose{suffix}"].floats(count, 72)
    place = person[f"trans{suffix}"].floats(count, 3)
    return MethodTrack(frames, pose[:, :3], pose[:, 3:], place, person["betas"].floats(count, None))


def read_gvhmr(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of GVHMR's results, one for each file in order of their names.

    The file `hmr4d_results.pt` is a torch file of one person; several people have a folder of such
    files.

    The layout is that of zju3dv/GVHMR at commit 44fbc19, tools/demo/demo.py and
    hmr4d/model/gvhmr/gvhmr_pl_demo.py: `smpl_params_global` and `smpl_params_incam`, SMPL-X
    with `global_orient` (T, 3), `body_pose` (T, 63), `transl` (T, 3) and `betas` (T, 10), and
    `K_fullimg` (T, 3, 3) px. The method follows one person through the whole video, in a world
    that begins at that person.

    Args:
        path: a file, or a folder with one file per person at any depth.
        model: body model to pose.

    Raises:
        InputError: the path is neither such a file nor such a folder.
    """
    files = [path] if path.is_file() else sorted(path.rglob("*.pt"))
    # The method keeps other torch files in preprocess/.
    files = [file for file in files if file.parent.name != "preprocess"]
    if not files:
        raise format_error(path, "hmr4d_results.pt, or a folder of such files", "none")
    people, used = [], ""
    for number, file in enumerate(files):
        content = read_pickled(file)
        world, seen = (
            _read_gvhmr_track(content[f"smpl_params_{name}"]) for name in ("global", "incam")
        )
        intrinsics = content["K_fullimg"].floats(len(seen.frames), 3, 3)
        joints, used = pose_track(world, model, "other")
        in_camera = pose_track(seen, model, "other")[0]
        focal, center = intrinsics[:, (0, 1), (0, 1)], intrinsics[:, :2, 2]
        people.append(Person(number, world.frames, joints, project_boxes(in_camera, focal, center)))
    return merge_people("own", people, {"shape": used})


def _read_gvhmr_track(parameters: Part) -> MethodTrack:
    place = parameters["transl"].floats(None, 3)
    turns = parameters["global_orient"].floats(len(place), 3)
    angles = parameters["body_pose"].floats(len(place), 63)
    return MethodTrack(np.arange(len(place)), turns, angles, place)


def read_tram(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of TRAM's result.

    The folder has `camera.npy` and `hps/hps_track_<n>.npy`, with all people in one world.

    The layout is that of yufu-wang/tram at commit 4861c11, scripts/estimate_camera.py,
    scripts/estimate_humans.py and lib/models/hmr_vimo.py: numpy files that hold a dictionary;
    of the camera `world_cam_R` (T, 3, 3), `world_cam_T` (T, 3), `img_focal` and `img_center`
    px; of a person torch tensors `pred_rotmat` (n, 24, 3, 3), `pred_shape` (n, 10),
    `pred_trans` (n, 1, 3) in camera axes and `frame` (n,). World points are `world_cam_R x +
    world_cam_T`, the shape is the mean over the frames (lib/pipeline/visualization.py).

    Args:
        path: the folder of the video.
        model: body model to pose.

    Raises:
        InputError: the folder has another layout.
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
    people, used = [], ""
    for number, file in sorted(files.items()):
        content = read_pickled(file)
        # A track consists of pieces, in temporal order.
        frames = content["frame"].frames()
        if frames[-1] >= len(turns):
            expected = f"frames below {len(turns)}, as the camera has"
            raise format_error(file, expected, f"{frames[-1]}")
        count = len(frames)
        vectors = rotation_vectors(content["pred_rotmat"].floats(count, 24, 3, 3))
        track = MethodTrack(
            frames=frames,
            global_orient=vectors[:, 0],
            body_pose=vectors[:, 1:].reshape(-1, 69),
            place=content["pred_trans"].floats(count, 3),
            betas=content["pred_shape"].floats(count, None).mean(0),
        )
        joints, used = pose_track(track, model, "smpl")
        world = np.einsum("fab,fjb->fja", turns[frames], joints) + shifts[frames, None]
        boxes = project_boxes(joints, np.full(2, focal), center)
        people.append(Person(number, frames, world, boxes))
    return merge_people("shared", people, {"shape": used})


def read_prompthmr(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of PromptHMR's result.

    The file is `results.pkl`, a joblib file with all people in one world.

    The layout is that of yufu-wang/PromptHMR at commit ea85d0a, pipeline/pipeline.py and
    pipeline/world.py: `people[id]` with `frames` (n,), `bboxes` (n, 4) x0 y0 x1 y1 px and
    `smplx_world`, SMPL-X with `pose` (n, 165), `shape` and `trans` (n, 3); `camera.img_center`
    px is the principal point of the images, which the method downscales.

    Args:
        path: joblib's file, or the folder it lies in.
        model: body model to pose.

    Raises:
        InputError: the file has another format.
    """
    content = read_pickled(path / "results.pkl" if path.is_dir() else path)
    people, used = [], ""
    for number, person in content["people"].by_person():
        frames = person["frames"].frames()
        count = len(frames)
        pose = person["smplx_world"]["pose"].floats(count, 165)
        place = person["smplx_world"]["trans"].floats(count, 3)
        joints, used = pose_track(
            MethodTrack(frames, pose[:, :3], pose[:, 3:66], place), model, "other"
        )
        people.append(Person(number, frames, joints, person["bboxes"].floats(count, None)[:, :4]))
    width, height = (2.0 * content["camera"]["img_center"].floats(2)).tolist()
    return merge_people("shared", people, {"shape": used}, (width, height))


def read_smpl(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of a file with `betas`, `global_orient`, `body_pose` and `transl`.

    Args:
        path: npz file, persons first, NaN where a person is missing (docs/reference/formats.md).
        model: body model to pose; betas of another body model are not used.

    Raises:
        InputError: the file has another format.
    """
    poses, named = read_poses(path)
    people, used = [], ""
    own = named == model.name and is_open_body(model.name)
    for person in range(poses.batch_shape[0]):
        there = np.isfinite(poses.transl[person]).all(-1)
        if not there.any():
            continue
        one = poses[person, there]
        track = MethodTrack(
            np.flatnonzero(there), one.global_orient, one.body_pose, one.transl, one.betas
        )
        same = named in (None, model.name)
        joints, used = pose_track(track, model, "open" if own else "smpl" if same else "other")
        people.append(Person(person, track.frames, joints))
    return merge_people("shared", people, {"shape": used})


_Piece = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]


def read_slahmr(path: Path, model: BodyModel, _: tuple[int, int], phase: str) -> MethodResult:
    """Return the people of SLAHMR's runs, all in one world.

    SLAHMR: a folder for each piece of the video.

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

    Args:
        path: a run's folder, or one that holds the folders of all pieces at any depth.
        model: body model to pose.
        phase: phase to read; its last iteration is used. HuMoR, the motion prior, is used in
            `motion_chunks`, not yet in `smooth_fit`.

    Raises:
        InputError: the folder has another layout.
    """
    runs = sorted(
        (_read_run(info, model, phase) for info in sorted(path.rglob("track_info.json"))),
        key=lambda run: run[0],
    )
    if not runs:
        raise format_error(path, "track_info.json of a run", "no such file")
    pieces: dict[int, list[_Piece]] = {}
    last = None
    for people, centers in (run[1:3] for run in runs):
        shift = np.zeros(3) if last is None else last - centers[0]
        last = centers[-1] + shift
        for person, (frames, joints, boxes) in people.items():
            pieces.setdefault(person, []).append((frames, joints + shift, boxes))
    found = []
    for person, some in sorted(pieces.items()):
        frames, joints, boxes = (np.concatenate(arrays) for arrays in zip(*some, strict=True))
        # Where pieces overlap, the first one is used.
        frames, first = np.unique(frames, return_index=True)
        found.append(Person(person, frames, joints[first], boxes[first]))
    notes = {"shape": runs[-1][3], "phase": phase, "pieces": str(len(runs))}
    return merge_people("shared", found, notes)


def _read_run(
    info: Path, model: BodyModel, phase: str
) -> tuple[int, dict[int, _Piece], NDArray[np.float64], str]:
    """Return first image, people by id, camera centres, and the body model of the shapes."""
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
    turns, pose, camera, shift = (
        Part(f"{where}: {name}", arrays[name][:, :length]).floats(count, length, *tail)
        for name, tail in (
            ("root_orient", (3,)),
            ("pose_body", (63,)),
            ("cam_R", (3, 3)),
            ("cam_t", (3,)),
        )
    )
    focal, center = _read_intrinsics(files[-1], length)
    begin = int(content["meta"]["data_interval"].integers(2)[0])
    start = int(content["meta"]["seq_interval"].integers(2)[0])
    people: dict[int, _Piece] = {}
    used = ""
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
        joints, used = pose_track(
            MethodTrack(rows, turns[row, rows], pose[row, rows], place[row, rows]), model, "other"
        )
        relative = np.einsum("fab,fjb->fja", camera[row, rows], joints) + shift[row, rows, None]
        boxes = project_boxes(relative, focal[rows], center[rows])
        people[number] = (begin + start + rows, joints, boxes)
    centers = -np.einsum("fba,fb->fa", camera[0], shift[0])
    return begin + start, people, centers, used


def _read_intrinsics(results: Path, length: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
