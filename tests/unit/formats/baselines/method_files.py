"""A scene of two people, and files of it in the layout of each method's own writing code."""

import json
import pickle
from collections import defaultdict

import numpy as np
from camera_builders import plain_camera
from scipy.spatial.transform import Rotation

from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.evaluation.matching import joint_boxes
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.rigid import Rigid

FRAMES, PEOPLE, WALK = 16, 2, 8.0
FIRST = 40
"""Match frame of the clip's first image."""
STEP = 0.01
"""Everybody is this far too high or too low by turns [m]."""
# Summed over any four frames it is zero, and so is its product with time: neither shift nor
# rotation takes any of it away.
PATTERN = STEP * np.tile([1.0, -1.0, -1.0, 1.0], FRAMES // 4)

model = load_open_body()
pelvis = model.joint_template[0]


def scene(seed=0):
    """The true bodies (persons, frames), walking along x, and the camera (frames,)."""
    rng = np.random.default_rng(seed)
    transl = np.zeros((PEOPLE, FRAMES, 3))
    transl[..., 0] = np.linspace(-WALK / 2, WALK / 2, FRAMES)
    transl[0, :, 1], transl[1, :, 1], transl[..., 2] = -4.0, 4.0, 1.1
    turns = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0]) * Rotation.from_rotvec(
        rng.normal(0.0, 0.3, (PEOPLE * FRAMES, 3))
    )
    pose = rng.normal(0.0, 0.2, (PEOPLE, FRAMES, 69))
    pose[..., 63:] = 0.0  # SMPL+H and SMPL-X have no joint for these
    bodies = BodyParameters(
        np.zeros(model.shapes), turns.as_rotvec().reshape(PEOPLE, FRAMES, 3), pose, transl
    )
    pan = Rotation.from_rotvec(np.linspace(-0.02, 0.02, FRAMES)[:, None] * [0.0, 0.0, 1.0])
    down = Rotation.from_rotvec([np.pi / 2 + np.arctan2(14.0, 70.0), 0.0, 0.0])
    rotation = (down * pan).as_matrix()
    camera = plain_camera(
        np.full(FRAMES, 3000.0), (960.0, 540.0), Rigid(rotation, -rotation @ [0.0, -70.0, 14.0])
    )
    return bodies, camera


def joints_of(bodies):
    return np.swapaxes(fold_keypoints(model, COCO17)(bodies), 0, 1)


def truth_of(bodies):
    joints = joints_of(bodies)
    return JointTracks(np.arange(FIRST, FIRST + FRAMES), np.arange(PEOPLE), joints)


def wobbled(bodies):
    transl = bodies.transl + PATTERN[:, None] * [0.0, 0.0, 1.0]
    return BodyParameters(bodies.betas, bodies.global_orient, bodies.body_pose, transl)


def moved(bodies, turn, shift):
    """Bodies in a frame x' = turn x + shift; `transl` comes after the turn about the pelvis."""
    orient = turn * Rotation.from_rotvec(np.array(bodies.global_orient.reshape(-1, 3)))
    place = turn.apply((bodies.transl + pelvis).reshape(-1, 3)) + shift
    shape = bodies.transl.shape
    return BodyParameters(
        bodies.betas,
        orient.as_rotvec().reshape(shape),
        bodies.body_pose,
        place.reshape(shape) - pelvis,
    )


def in_camera(bodies, camera):
    pose = camera.cam_from_world
    turn = Rotation.from_matrix(np.tile(pose.rotation, (PEOPLE, 1, 1)))
    return moved(bodies, turn, np.tile(pose.translation, (PEOPLE, 1)))


def y_up(bodies, seed=5):
    turn = Rotation.from_rotvec([0.0, 0.1 * seed, 0.0]) * Rotation.from_rotvec([-np.pi / 2, 0, 0])
    return moved(bodies, turn, np.array([3.0, 0.5, seed]))


def boxes_of(bodies, camera):
    return joint_boxes(joints_of(bodies), camera).swapaxes(0, 1)


def single(array):
    return np.asarray(array, dtype=np.float32)


def matrices(bodies):
    """(persons, frames, 24, 3, 3), the root first."""
    vectors = np.concatenate([bodies.global_orient, bodies.body_pose], axis=-1)
    turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return single(turns.reshape(PEOPLE, FRAMES, 24, 3, 3))


def write_glamr(folder, bodies, camera):
    world = y_up(bodies)
    pixels = camera.project(joints_of(bodies).reshape(FRAMES, -1, 3)).reshape(FRAMES, PEOPLE, -1, 2)
    people = {}
    for person in range(PEOPLE):
        points = np.zeros((FRAMES, 26, 2), np.float32)
        points[:, :17] = pixels[:, person]
        people[person] = {
            "exist_frames": np.ones(FRAMES, bool),
            "smpl_orient_world": single(world.global_orient[person]),
            "smpl_pose": single(world.body_pose[person]),
            "smpl_beta": single(np.ones((FRAMES, 10))),
            "root_trans_world": single(world.transl[person] + pelvis),
            "scale": None,
            "kp_2d": points,
        }
    content = {"person_data": people, "rel_transform_cam": {(0, 1): np.eye(4)}, "gt": {}}
    path = folder / "clip_seed1.pkl"
    path.write_bytes(pickle.dumps(content))
    return path


def write_hybrik_all(folder, bodies, camera):
    seen = in_camera(bodies, camera)
    pixels = camera.project(joints_of(bodies).reshape(FRAMES, -1, 3)).reshape(FRAMES, PEOPLE, -1, 2)
    people = {
        person: {
            "smpl_pose_quat_wroot": matrices(seen)[person].reshape(FRAMES, 54, 4),
            "smpl_beta": single(np.ones((FRAMES, 10))),
            # Its depth comes from a focal length of 1000 px: three times too near.
            "root_trans": single(seen.transl[person] / 3.0),
            "kp_2d": single(pixels[:, person]),
            "frames": np.arange(FRAMES),
        }
        for person in range(PEOPLE)
    }
    path = folder / "pose.pkl"
    path.write_bytes(pickle.dumps(people))
    return path


def write_humans4d(folder, bodies, camera):
    import joblib

    seen = in_camera(bodies, camera)
    turns, boxes = matrices(seen), boxes_of(bodies, camera)
    content = {}
    for frame in range(FRAMES):
        people = [
            {
                "global_orient": turns[person, frame, None, 0],
                "body_pose": turns[person, frame, 1:],
                "betas": single(np.ones(10)),
            }
            for person in range(PEOPLE)
        ]
        around = [np.r_[box[frame, :2], box[frame, 2:] - box[frame, :2]] for box in boxes]
        lost = {"tid": 9, "smpl": people[0], "bbox": around[0], "camera": np.ones(3), "age": 2}
        rows = [
            {"tid": person + 1, "smpl": people[person], "bbox": around[person], "age": 0}
            | {"camera": single(seen.transl[person, frame])}
            for person in range(PEOPLE)
        ] + [lost]
        content[f"images/{frame:06d}.jpg"] = {
            "time": frame,
            "tracked_time": [row["age"] for row in rows],
            **{key: [row[key] for row in rows] for key in ("tid", "smpl", "bbox", "camera")},
            "mask": [{"size": [8, 8], "counts": b"x"}] * len(rows),
        }
    path = folder / "demo_clip.pkl"
    joblib.dump(content, path, compress=3)
    return path


def write_slahmr(folder, bodies, camera, phase="motion_chunks"):
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1])
    pieces = ((0, 8, np.array([2.0, 0.0, 1.0])), (8, FRAMES, np.array([-1.0, 4.0, 0.3])))
    for first, end, shift in pieces:
        run = folder / f"clip-all-shot-0-{first}-{end}"
        (run / phase).mkdir(parents=True)
        own = moved(bodies, turn, shift)
        part = slice(first, end)
        to_camera = camera.cam_from_world[part].rotation @ turn.as_matrix().T
        to_origin = camera.cam_from_world[part].translation - to_camera @ shift
        arrays = {
            "root_orient": own.global_orient[:, part],
            "pose_body": own.body_pose[:, part, :63],
            "trans": own.transl[:, part],
            "betas": np.ones((PEOPLE, 16)),
            "latent_pose": np.zeros((PEOPLE, end - first, 32)),
            "cam_R": np.tile(to_camera, (PEOPLE, 1, 1, 1)),
            "cam_t": np.tile(to_origin, (PEOPLE, 1, 1)),
            "intrins": np.array([3000.0, 3000.0, 960.0, 540.0]),
        }
        early = {**arrays, "trans": 0.0 * arrays["trans"]}
        for iteration, content in ((20, early), (159, arrays)):
            name = f"clip_{iteration:06d}_world_results.npz"
            np.savez(run / phase / name, **{key: single(a) for key, a in content.items()})
            cameras = {"intrinsics": [[3000.0, 3000.0, 960.0, 540.0]] * (end - first)}
            file = run / phase / f"clip_cameras_{iteration:06d}.json"
            file.write_text(json.dumps(cameras))
        tracks = {
            str(7 + person): {"index": person, "vis_mask": [True] * (end - first)}
            for person in range(PEOPLE)
        }
        meta = {"seq_interval": [0, end - first], "data_interval": [first, end]}
        (run / "track_info.json").write_text(json.dumps({"tracks": tracks, "meta": meta}))
    return folder


def write_wham(folder, bodies, camera):
    import joblib

    seen = in_camera(bodies, camera)
    results = defaultdict(dict)
    # The method takes the image's diagonal for its focal length: the depth follows.
    deeper = np.hypot(1920, 1080) / 3000.0
    hips = [COCO17.index("left_hip"), COCO17.index("right_hip")]
    for person in range(PEOPLE):
        own = y_up(bodies, seed=person)
        middle = joints_of(own)[:, person, hips].mean(1)
        place = seen.transl[person].copy()
        place[:, 2] *= deeper
        results[np.int64(person)] = {
            "pose": np.c_[seen.global_orient[person], seen.body_pose[person]],
            "trans": place,
            "pose_world": np.c_[own.global_orient[person], own.body_pose[person]],
            "trans_world": middle,
            "betas": np.ones((FRAMES, 10)),
            "verts": np.zeros((FRAMES, 4, 3)),
            "frame_ids": np.arange(FRAMES),
        }
    path = folder / "wham_output.pkl"
    joblib.dump(results, path)
    return path


def write_gvhmr(folder, bodies, camera):
    import torch

    seen = in_camera(bodies, camera)
    for person in range(PEOPLE):
        own = y_up(bodies, seed=person)
        content = {
            f"smpl_params_{name}": {
                "body_pose": torch.tensor(single(some.body_pose[person, :, :63])),
                "betas": torch.ones(FRAMES, 10),
                "global_orient": torch.tensor(single(some.global_orient[person])),
                "transl": torch.tensor(single(some.transl[person])),
            }
            for name, some in (("global", own), ("incam", seen))
        }
        k = np.array([[3000.0, 0.0, 960.0], [0.0, 3000.0, 540.0], [0.0, 0.0, 1.0]])
        content["K_fullimg"] = torch.tensor(single(k)).repeat(FRAMES, 1, 1)
        path = folder / f"person_{person}" / "hmr4d_results.pt"
        path.parent.mkdir()
        torch.save(content, path)
        (path.parent / "preprocess").mkdir()
        torch.save({"bbx_xys": torch.ones(FRAMES, 3)}, path.parent / "preprocess" / "bbx.pt")
    return folder


def write_tram(folder, bodies, camera):
    import torch

    turn = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0])
    pose = camera.cam_from_world.inverse()
    world = {
        "pred_cam_R": pose.rotation,
        "world_cam_R": single(turn.as_matrix() @ pose.rotation),
        "world_cam_T": single(turn.apply(np.array(pose.translation)) + [5.0, 0.0, 1.0]),
        "img_focal": np.float32(3000.0),
        "img_center": np.array([960.0, 540.0]),
    }
    np.save(folder / "camera.npy", world)
    (folder / "hps").mkdir()
    seen = in_camera(bodies, camera)
    for person in range(PEOPLE):
        result = {
            "pred_cam": torch.ones(FRAMES, 3),
            "pred_shape": torch.ones(FRAMES, 10),
            "pred_rotmat": torch.tensor(matrices(seen)[person]),
            "pred_trans": torch.tensor(single(seen.transl[person, :, None])),
            "frame": torch.arange(FRAMES),
        }
        np.save(folder / "hps" / f"hps_track_{person}.npy", result)
    return folder


def write_prompthmr(folder, bodies, camera):
    import joblib

    world, boxes = y_up(bodies), boxes_of(bodies, camera)
    people = {}
    for person in range(PEOPLE):
        pose = np.zeros((FRAMES, 165))
        pose[:, :3], pose[:, 3:66] = world.global_orient[person], world.body_pose[person, :, :63]
        people[person + 1] = {
            "frames": np.arange(FRAMES),
            "track_id": person + 1,
            "bboxes": boxes[person] / 2.0,  # its images are smaller
            "smplx_world": {
                "pose": single(pose),
                "shape": single(np.ones((FRAMES, 10))),
                "trans": single(world.transl[person]),
            },
        }
    camera_part = {"img_focal": 1500.0, "img_center": np.array([480.0, 270.0])}
    path = folder / "results.pkl"
    joblib.dump({"people": people, "camera": camera_part, "has_tracks": True}, path)
    return path


def write_smpl(folder, bodies, camera):
    from worldpose.formats.joints_file import write_poses

    path = folder / "poses.npz"
    write_poses(path, y_up(bodies), model.name)
    return path


WRITERS = {
    "hybrik": write_hybrik_all,
    "4dhumans": write_humans4d,
    "glamr": write_glamr,
    "slahmr": write_slahmr,
    "slahmr-true-cameras": write_slahmr,
    "slahmr-no-humor": lambda *given: write_slahmr(*given, "smooth_fit"),
    "wham": write_wham,
    "gvhmr": write_gvhmr,
    "tram": write_tram,
    "prompthmr": write_prompthmr,
    "smpl": write_smpl,
}
