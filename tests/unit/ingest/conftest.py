"""A tiny match: two static cameras, a broadcast camera and one clip of three frames."""

import numpy as np
import pytest
from run_records import calibration, match_spec

from data_contracts.keypoints import KeypointDetections
from worldpose.ingest.writing import write_match

CAMERA_ANGLES = {"cam1": 0.5, "cam2": -0.3}


@pytest.fixture
def make_people():
    def people(first_frame=0, frames=3, detections=2, seed=0):
        rng = np.random.default_rng(seed)
        keypoints = rng.uniform(100, 900, (frames, detections, 17, 2)).astype(np.float32)
        confidence = rng.uniform(0.1, 1, (frames, detections, 17)).astype(np.float32)
        if frames and detections:
            confidence[0, 0, 3] = np.nan
        keypoints[np.isnan(confidence)] = np.nan
        low, high = np.nanmin(keypoints, axis=2), np.nanmax(keypoints, axis=2)
        return KeypointDetections(
            frame=np.arange(first_frame, first_frame + frames, dtype=np.int64),
            keypoints=keypoints,
            confidence=confidence,
            boxes=np.concatenate([low, high], axis=-1),
            score=rng.uniform(0, 1, (frames, detections)).astype(np.float32),
        )

    return people


@pytest.fixture
def make_camera():
    def camera(name="cam1", angle=0.5, size=(1920, 1080)):
        c, s = float(np.cos(angle)), float(np.sin(angle))
        return calibration(
            name,
            **{"image_size": size, "focal_px": (1000.1, 1001.2)},
            **{
                "principal_point_px": (960.3, 540.7),
                "distortion": (-0.1, 0.02, 1e-4, -2e-4, 0.003),
            },
            rotation=((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)),
            translation=(0.1, -0.2, 30.123456789012345),
        )

    return camera


@pytest.fixture
def spec():
    main = {"kind": "broadcast", "width": 1280, "height": 720}
    goal = {"first_frame": 5, "frame_count": 3, "broadcast": "main"}
    return match_spec(
        {"cam1": {}, "cam2": {"offset_frames": 10}, "main": main},
        {"goal": goal, "corner": {"first_frame": 9, "frame_count": 2}},
        **{"match_id": "tiny", "fps": 50.0},
    )


@pytest.fixture
def write_tiny(tmp_path, spec, make_people, make_camera):
    """Write the tiny match with these given cameras and further data, and return its folder."""

    def write(calibrated=("cam1", "cam2"), **further):
        folder = tmp_path / "tiny"
        write_match(
            folder,
            spec,
            calibrations={name: make_camera(name, CAMERA_ANGLES[name]) for name in calibrated},
            observations={
                "cam1": make_people(5, 6, seed=1),
                "cam2": make_people(15, 6, seed=2),
                "goal": make_people(0, 3, seed=3),
            },
            **further,
        )
        return folder

    return write


@pytest.fixture
def match_folder(write_tiny):
    """A complete match folder on disk; static cameras cover match frames 5 to 10."""
    return write_tiny()
