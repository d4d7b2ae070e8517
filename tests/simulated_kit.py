"""Inputs of a pose challenge, and their truth, from a simulated match."""

import shutil
from typing import Final

import numpy as np

from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import BODY25, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.monocular import place_monocular_poses, read_monocular
from worldpose.body_fitting.pose_space import SIZE, SPREADS
from worldpose.formats.archives import read_npz
from worldpose.formats.challenge import (
    ChallengeClip,
    challenge_truth,
    write_challenge,
    write_challenge_camera,
    write_pitch_points,
    write_submission,
)
from worldpose.formats.joints_file import read_joints, read_poses
from worldpose.formats.keypoint_files import read_keypoint_arrays
from worldpose.formats.release_cameras import read_camera, write_moving_camera
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.pitch_file import read_pitch
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.reference import CLIP_ID

TRUTH: Final = "true.zip"
"""The true submission, beside the kit's folders."""


def lay_out_kit(match, kit, name, *, all_poses=False):
    """Add a sequence to a kit: what participants get, and the true submission as `true.zip`.

    Boxes are those of the true bodies. 2D skeletons are the simulated detector's, and 3D skeletons
    the mean body in the simulated monocular method's poses, in the camera's axes.

    Args:
        match: a simulated match with a broadcast video.
        kit: the folder; `true.zip` holds this sequence alone.
        name: of the sequence.
        all_poses: whether the camera file has every frame's pose, not that of the first alone.
    """
    model, truth = load_open_body(), read_joints(match / "reference" / "joints.npz")
    camera = read_camera(match / "reference" / "cameras" / f"{CLIP_ID}.npz")
    poses, _ = read_poses(match / "reference" / "poses" / f"{CLIP_ID}.npz")
    true = challenge_truth(model, poses, camera)
    shape = true.clip.skel_2d.shape
    seen = read_keypoint_arrays(match / "detections" / f"{CLIP_ID}.npz")
    person = read_npz(match / "reference" / "identities" / f"{CLIP_ID}.npz", 1 << 30)["person"]
    flat = np.full(shape, np.nan)
    places = [BODY25.index(each) for each in COCO17]
    for column, own in enumerate(true.persons):
        row, detection = np.nonzero(person == own)
        points = np.full((len(row), len(BODY25), 2), np.nan)
        points[:, places] = seen.keypoints[row, detection]
        flat[seen.frame[row], column] = points
    estimates = read_monocular(match / "estimates" / f"{CLIP_ID}.npz")
    joints = truth.joints[:, true.persons].astype(np.float64)
    found = place_monocular_poses(estimates, camera, np.arange(shape[0]), joints)
    angles = found.angles @ SPREADS[SIZE].T
    orient = camera.cam_from_world.rotation[:, None] @ found.orient
    known = np.isfinite(orient)
    rotvec = Rigid(np.where(known, orient, np.eye(3)), np.zeros(3)).rotvec
    angles = np.nan_to_num(angles)
    bodies = BodyParameters(np.zeros(model.shapes), rotvec, angles, np.zeros((*shape[:2], 3)))
    deep = fold_keypoints(model, BODY25)(bodies)
    deep -= deep[:, :, BODY25.index("mid_hip"), None]
    there = np.asarray(np.isfinite(true.clip.boxes).all(-1))
    flat[~there], deep[~(there & known.all((-1, -2)))] = np.nan, np.nan
    write_challenge(kit, {name: ChallengeClip(true.clip.boxes, flat, deep)}, 2026)
    file = kit / "cameras" / f"{name}.npz"
    if all_poses:
        write_moving_camera(file, camera)
    else:
        write_challenge_camera(file, camera, 2026)
    (kit / "videos").mkdir(parents=True, exist_ok=True)
    shutil.copyfile(match / "broadcast" / f"{CLIP_ID}.mp4", kit / "videos" / f"{name}.mp4")
    pitch = read_pitch(match, read_match(match).spec)
    assert pitch is not None  # a simulated broadcast clip has one
    samples = PitchTemplate.from_spec(pitch).sample_lines(0.5)
    write_pitch_points(kit / "pitch_points.txt", samples.points_world)
    submission = np.where(there.T[..., None, None], true.submission, np.nan)
    write_submission(kit / TRUTH, {name: submission})
