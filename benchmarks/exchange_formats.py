"""Print size and errors of exported files read by other programs: glTF by three.js, C3D by c3d.

python benchmarks/exchange_formats.py NODE_MODULES

NODE_MODULES holds three and gltf-validator (`npm ci` in infra/review_pages). 22 people in random
motion for 30 s at 50 frames per second.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyParameters
from worldpose.evaluation.marker_reference import read_markers
from worldpose.formats.c3d_file import write_c3d
from worldpose.formats.gltf_file import AnimatedBody, write_gltf
from worldpose.formats.joints_file import JointTracks

PEOPLE, FRAMES, FPS = 22, 1500, 50.0
CHECKED = (0, 333, 700, FRAMES - 1)
SCRIPT = Path(__file__).parents[1] / "tests" / "unit" / "formats" / "gltf_in_three.mjs"


def random_motion(seed: int) -> BodyParameters:
    """Return a person (frames,) who wanders over the pitch with changing joint angles."""
    rng = np.random.default_rng(seed)

    def wander(size: int, step: float) -> np.ndarray:
        return np.cumsum(rng.normal(0.0, step, (FRAMES, size)), axis=0)

    return BodyParameters(
        rng.standard_normal((1, 10)),
        rng.uniform(-3.0, 3.0, 3) + wander(3, 0.05),
        rng.uniform(-1.0, 1.0, 69) + wander(69, 0.02),
        rng.uniform(-50.0, 50.0, 3) + wander(3, 0.1),
    )


def main() -> None:
    """Write the files, read them by the other programs and print the differences."""
    model = load_open_body()
    people = [AnimatedBody(f"person_{n:03d}", random_motion(n), {}) for n in range(PEOPLE)]
    with tempfile.TemporaryDirectory() as folder:
        scene, marks = Path(folder) / "scene.glb", Path(folder) / "person.c3d"
        write_gltf(scene, model, people, FPS, cameras={}, markings=[], notes={})
        times = [f"{frame / FPS:.9f}" for frame in CHECKED]
        command = ["node", str(SCRIPT), sys.argv[1], str(scene), *times]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found = json.loads(done.stdout)
        far, turned = [], []
        for frame, posed in zip(CHECKED, found["frames"], strict=True):
            for person in people:
                poses = person.poses[frame]
                nodes = [posed["nodes"][f"{person.name}_{j}"] for j in SKELETONS["smpl24"]]
                places = np.array([node["place"] for node in nodes])
                far.append(np.linalg.norm(places - model.joints(poses), axis=-1).max())
                truth = Rotation.from_matrix(model.articulate(poses).rotations)
                turns = Rotation.from_quat([node["turn"] for node in nodes]) * truth.inv()
                turned.append(np.degrees(turns.magnitude()).max())
        print(f"gltf: {scene.stat().st_size / 1e6:.1f} MB, {found['issues']['messages']}")
        print(f"gltf: joints {1e3 * max(far):.3f} mm, rotations {max(turned):.4f} deg at most")
        joints = np.random.default_rng(0).uniform(-60.0, 60.0, (FRAMES, 1, 17, 3))
        tracks = JointTracks(np.arange(FRAMES), np.array([0]), joints)
        write_c3d(marks, tracks, 0, FPS, {})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # c3d: no analogue data
            points = read_markers(marks).points
        print(f"c3d: joints {1e3 * np.abs(points - joints[:, 0]).max():.4f} mm at most")


if __name__ == "__main__":
    main()
