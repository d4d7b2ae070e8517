"""The page shows the view in which a person's keypoints have the largest residuals."""

from types import SimpleNamespace

import numpy as np
import xarray as xr
from camera_builders import plain_camera

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from flows.reports.clips import worst_views
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.simulation.scene import look_at

FRAMES = np.arange(20, 24)


def camera(x):
    return plain_camera(
        2000.0, (960.0, 540.0), look_at(np.array([x, -60.0, 20.0]), np.zeros(3), 0.0)
    )


def test_the_farthest_views_of_two_people_come_worst_first():
    rng = np.random.default_rng(0)
    cameras = {"east": camera(30.0), "west": camera(-30.0)}
    places = np.array([[-5.0, 0.0, 0.0], [5.0, 3.0, 0.0]])[:, None]
    joints = (
        places
        + rng.uniform(-0.3, 0.3, (4, 2, 17, 3))
        + np.linspace(1.7, 0.1, 17)[:, None] * [[0.0, 0.0, 1.0]]
    )
    tracks = JointTracks(FRAMES, np.array([4, 9]), joints)
    index = np.tile(np.array([1, 0]), (4, 2, 1))  # detections come in the other order
    index[3, 0, 1] = -1
    run = {}
    for name, one in cameras.items():
        seen = one.project(joints.reshape(-1, 3)).reshape(4, 2, 17, 2)[:, ::-1].copy()
        height = np.ptp(seen[..., 1], axis=-1)
        if name == "west":
            seen[1, 1, :, 0] += 0.5 * height[1, 1]  # person 4
            seen[2, 0, :, 0] += 0.2 * height[2, 0]  # person 9
            seen[2, 1, :10] = np.nan  # seven joints are too few
            seen[2, 1, 10:] += 900.0
        else:
            seen[3, 0] += 900.0  # no person's
        run[f"ingest/{name}"] = xr.Dataset(
            {"keypoints": (("frame", "detection", "joint", "axis"), seen)}, coords={"frame": FRAMES}
        )
    run["tracking/clip"] = xr.Dataset(
        {"detection_index": (("frame", "camera", "person"), index)},
        coords={"frame": FRAMES, "person": [4, 9]},
    )
    stacked = Camera.stack(list(cameras.values()))
    run["bundle_adjustment/cameras"] = xr.Dataset(
        {
            "focal": (("camera", "a"), stacked.focal),
            "principal_point": (("camera", "a"), stacked.principal_point),
            "distortion": (("camera", "k"), stacked.distortion),
            "rotation": (("camera", "i", "j"), stacked.cam_from_world.rotation),
            "translation": (("camera", "i"), stacked.cam_from_world.translation),
            "image_size": (("camera", "a"), stacked.image_size),
        },
        coords={"camera": list(cameras)},
    )
    spec = MatchSpec(
        match_id="m",
        fps=50.0,
        cameras=tuple(CameraSpec(id=name, width=1920, height=1080) for name in cameras),
        clips=(ClipSpec(id="clip", first_frame=20, frame_count=4),),
    )
    match = SimpleNamespace(folder=SimpleNamespace(detections={"east": 1, "west": 1}, spec=spec))
    assert worst_views(run, match, "clip", tracks) == [(1, 1, 0, 50), (2, 1, 1, 20)]
