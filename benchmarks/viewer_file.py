"""Print size, first paint, frames per second and decoding errors of a viewer file in a browser.

python benchmarks/viewer_file.py [OUT.html]

22 people in random motion for 30 s at 50 frames per second, 16 static cameras and a broadcast
camera, in headless Chromium that draws with the processor alone. Needs Chromium, and
playwright-core (`npm ci` in infra/review_pages).
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

import numpy as np
from exchange_formats import FPS, FRAMES, PEOPLE, random_motion
from scipy.spatial.transform import Rotation

from data_contracts.pitch import PitchSpec
from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyParameters
from worldpose.formats.viewer_file import ViewerClip, ViewerPerson, write_viewer
from worldpose.geometry.cameras import Camera
from worldpose.reports.drawing import markings, person_color

CHECKED = (0, 333, 700, FRAMES - 1)
MODULES = Path(__file__).parents[1] / "infra" / "review_pages" / "node_modules"
SCRIPT = Path(__file__).with_suffix(".mjs")
LOOKS_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def camera(turns: np.ndarray, place: np.ndarray, focal: float) -> Camera:
    """Return cameras (frames,) at a place, from turns about the vertical (frames,) [rad]."""
    about = Rotation.from_rotvec(np.outer(turns, [0.0, 0.0, 1.0])).as_matrix()
    rotations = LOOKS_ALONG_Y @ about.swapaxes(-1, -2)
    intrinsics = np.array([[focal, 0.0, 959.5], [0.0, focal, 539.5], [0.0, 0.0, 1.0]])
    return Camera.from_matrices(
        np.broadcast_to(intrinsics, (len(turns), 3, 3)),
        np.zeros((len(turns), 5)),
        rotations,
        -(rotations @ place),
        np.array([1920, 1080]),
    )


def random_clip() -> ViewerClip:
    """Return the clip, with evidence of every joint and two named teams."""
    people = [random_motion(seed) for seed in range(PEOPLE)]

    def stack(name: str) -> np.ndarray:
        each = [getattr(person, name) for person in people]
        return np.stack([np.broadcast_to(a, (FRAMES, a.shape[-1])) for a in each], axis=1)

    rng = np.random.default_rng(0)
    transl = np.clip(stack("transl"), [-52.0, -33.0, 0.9], [52.0, 33.0, 1.1])
    rings = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    still = {
        f"cam{n:02d}": camera(
            np.array([a]), np.array([70.0 * np.sin(a), -50.0 * np.cos(a), 12.0]), 2000.0
        )[0]
        for n, a in enumerate(rings)
    }
    return ViewerClip(
        clip="random",
        fps=FPS,
        frames=np.arange(FRAMES),
        people=tuple(
            ViewerPerson(n, f"Player {n + 1}", "triangulated", "AB"[n % 2], person_color(n))
            for n in range(PEOPLE)
        ),
        joints=np.full((FRAMES, PEOPLE, 17, 3), np.nan),
        spread=rng.uniform(0.003, 0.2, (FRAMES, PEOPLE, 17)),
        views=rng.integers(0, 12, (FRAMES, PEOPLE, 17)),
        ground=np.full((FRAMES, PEOPLE, 3), np.nan),
        height=np.full(PEOPLE, np.nan),
        bodies=BodyParameters(stack("betas"), stack("global_orient"), stack("body_pose"), transl),
        model=load_open_body(),
        cameras=still,
        broadcast=camera(
            0.3 * np.sin(np.arange(FRAMES) / 200.0), np.array([0.0, -80.0, 18.0]), 3500.0
        ),
        markings=markings(PitchSpec()),
        notes={"match": "random", "licence": "none", "units": "metres, seconds"},
    )


def main() -> None:
    """Write the file, open it in the browser and print what is measured."""
    clip = random_clip()
    assert clip.bodies is not None
    assert clip.model is not None
    page = (files("flows.reports") / "viewer.html").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(sys.argv[1] if len(sys.argv) > 1 else f"{folder}/viewer.html").resolve()
        write_viewer(out, page, [clip], {})
        print(f"file: {out.stat().st_size / 1e6:.2f} MB, without data {len(page) / 1e6:.2f} MB")
        task = {
            "modules": str(MODULES / "package.json"),
            "chromium": shutil.which("chromium"),
            "file": str(out),
            "frames": CHECKED,
        }
        given = Path(folder) / "task.json"
        given.write_text(json.dumps(task))
        done = subprocess.run(["node", SCRIPT, given], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["errors"] == seen["outside"] == []
    far, turned = [], []
    for frame, people in zip(CHECKED, seen["people"], strict=True):
        poses = clip.bodies[frame]
        joints = np.array([person["joints"] for person in people])
        far.append(np.linalg.norm(joints - clip.model.joints(poses), axis=-1).max())
        turns = np.array([person["rotations"] for person in people]).reshape(-1, 3, 3)
        truth = clip.model.articulate(poses).rotations.reshape(-1, 3, 3)
        apart = Rotation.from_matrix(turns) * Rotation.from_matrix(truth).inv()
        turned.append(np.degrees(apart.magnitude().max()))
    print(f"browser: joints {1e3 * max(far):.3f} mm, rotations {max(turned):.4f} deg at most")
    print(f"first paint {seen['paint']:.0f} ms, 3D picture {seen['picture']:.0f} ms after opening")
    for name, value in seen["rates"].items():
        print(f"{name}: {value['rate']:.1f} frames/s, p95 {value['p95']:.1f} ms between frames")
    print(f"load {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors, {seen['renderer']}")


if __name__ == "__main__":
    main()
