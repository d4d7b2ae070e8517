"""Time and peak memory of writing, checking and counting a simulated data set of any size.

Each step runs in a separate process, to measure its own peak:

    python benchmarks/data_set_size.py /tmp/data 88 1694 17

writes 88 clips of 1694 frames with 17 people, 2.53 million poses, the size of the paper's data set
(X1, X2), then checks and counts them.
"""

import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

STEPS = ("write", "check", "count")
FPS = 50.0


def write(folder: Path, clips: int, frames: int, people: int) -> None:
    """Write clips of people who run in circles at 2.4 m/s before a panning, zooming camera."""
    from worldpose.body.body_file import OPEN_BODY, find_body
    from worldpose.body.model import BodyParameters
    from worldpose.formats.challenge import write_moving_camera
    from worldpose.formats.joints_file import write_poses
    from worldpose.geometry.cameras import Camera
    from worldpose.geometry.rigid import Rigid

    model = find_body(OPEN_BODY)
    height = 0.95  # of a standing body's pelvis [m]
    for clip in range(clips):
        rng = np.random.default_rng(clip)
        time_s = np.arange(frames) / FPS
        center = rng.uniform([-25.0, -20.0], [25.0, 20.0], (people, 2))
        phase, radius = rng.uniform(0, 2 * np.pi, (2, people)), rng.uniform(2.0, 8.0, people)
        angle = phase[0][:, None] + (2.4 / radius)[:, None] * time_s
        around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        transl = np.empty((people, frames, 3))
        transl[..., :2] = center[:, None] + radius[:, None, None] * around
        transl[..., 2] = height
        transl -= model.joint_template[0]
        swing = np.sin(2 * np.pi * 1.4 * time_s + phase[1][:, None])
        pose = np.zeros((people, frames, 23, 3))
        pose[..., 0, 0], pose[..., 1, 0] = 0.3 * swing, -0.3 * swing  # hips
        pose[..., 15, 2], pose[..., 16, 2] = -1.2, 1.2  # arms down
        orient = np.tile([np.pi / 2, 0.0, 0.0], (people, frames, 1))
        bodies = BodyParameters(np.zeros(10), orient, pose.reshape(people, frames, 69), transl)
        write_poses(folder / "poses" / f"C_{clip:03d}.npz", bodies, model.name)
        down = Rigid.from_rotvec([np.pi / 2 + np.arctan2(14.0, 70.0), 0.0, 0.0], np.zeros(3))
        pan = np.zeros((frames, 3))
        pan[:, 2] = 0.15 * np.sin(0.2 * time_s)
        turn = down.rotation @ Rigid.from_rotvec(pan, np.zeros(3)).rotation
        camera = Camera(
            focal=np.repeat(2200.0 + 200.0 * np.sin(0.1 * time_s)[:, None], 2, axis=1),
            principal_point=np.tile([960.0, 540.0], (frames, 1)),
            distortion=np.zeros((frames, 5)),
            cam_from_world=Rigid(turn, -turn @ np.array([0.0, -70.0, 14.0])),
            image_size=np.array([1920, 1080]),
        )
        write_moving_camera(folder / "cameras" / f"C_{clip:03d}.npz", camera)


def check(folder: Path) -> None:
    """Check the data set."""
    from flows.results.dataset import check as check_data_set

    report = check_data_set(folder)
    faults = sorted({finding.fault for finding in report.findings})
    print(f"  {len(report.clips)} clips checked, findings: {', '.join(faults) or 'none'}")


def count(folder: Path) -> None:
    """Count the data set."""
    from flows.results.dataset import count as count_data_set

    found = count_data_set([folder])
    print(f"  {found.frames} frames, {found.poses} poses, {found.distance_km:.1f} km")


def main() -> None:
    """Run one step, or all in separate processes."""
    folder = Path(sys.argv[1])
    if sys.argv[2] in STEPS:
        started = time.perf_counter()
        arguments = [int(n) for n in sys.argv[3:]] if sys.argv[2] == "write" else []
        globals()[sys.argv[2]](folder, *arguments)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{sys.argv[2]}: {time.perf_counter() - started:.1f} s, {peak:.0f} MB")
        return
    for step in STEPS:
        subprocess.run([sys.executable, __file__, str(folder), step, *sys.argv[2:]], check=True)


if __name__ == "__main__":
    main()
