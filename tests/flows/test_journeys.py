"""Journeys of users without truth: from files to a report and an export, by the command line.

No match here has a folder `reference`. Every command but `simulate` and `run` is a process of its
own, as users start it: one that has imported the libraries before hides errors of their imports.
"""

import csv
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from command_line import succeed, worldpose
from test_broadcast_run import remove_static_cameras

import worldpose as library
from worldpose.body.body_file import load_open_body, save_body
from worldpose.formats.release_cameras import read_camera

NEW_PROCESS = {"COLUMNS": "200"}
"""An environment of its own makes a command a new process."""
NOISE_PX = 1.0
RING = [(16.0 * np.cos(angle), 16.0 * np.sin(angle)) for angle in (0.4, 2.0, 3.6, 5.2)]
MAST = [(-0.3, -30.0), (0.3, -30.0)]


@dataclass(frozen=True)
class Journey:
    """A folder with a finished run of `match` in `project`, and what its user does next."""

    folder: Path

    def command(self, name, *arguments):
        match = library.read_match(self.folder / "match").spec.match_id
        project = ("--project", self.folder / "project")
        return worldpose(name, match, *arguments, *project, environment=NEW_PROCESS)

    def report(self, out):
        answer = self.command("report", "--out", out)
        assert answer.code == 0, answer.err
        return out.read_text()

    def export(self, kind, out):
        answer = self.command("export", "--format", kind, "--out", out)
        assert answer.code == 0, answer.err
        return out

    def median_error(self, out):
        """Median distance [m] of an exported person's joints from those of the nearest true one."""
        found = library.read_joints(self.export("joints", out) / "joints.npz")
        truth = np.load(self.folder / "truth.npy")[found.frames]
        distances = np.linalg.norm(found.joints[:, :, None] - truth[:, None], axis=-1).mean(-1)
        return np.nanmedian(np.nanmin(distances, axis=2))


def travel(folder, *options, accepted=0):
    """Run the match of a folder, which has no truth; return what the command said."""
    assert not (folder / "match" / "reference").exists()
    answer = worldpose("run", folder / "match", "--project", folder / "project", *options)
    assert answer.code == accepted, answer.err
    (folder / "said.txt").write_text(answer.err + answer.out)
    return Journey(folder)


def simulate(folder, *scenario):
    """Make the input of a journey, and put its true joints aside."""
    succeed("simulate", *scenario, "--no-stills", "--out", folder / "match")
    truth = library.read_joints(folder / "match/reference/joints.npz").joints
    np.save(folder / "truth.npy", truth)
    for camera in (folder / "match/reference/cameras").glob("clip.npz"):
        camera.rename(folder / "truth_camera.npz")
    shutil.rmtree(folder / "match/reference")
    return truth


def camera_at(x, y, *, aim=(0.0, 0.0), height=3.0, focal=900.0, size=(1280, 720)):
    """Return a camera that looks at a point 1 m above the ground."""
    center = np.array([x, y, height])
    ahead = np.array([*aim, 1.0]) - center
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    middle = [(size[0] - 1) / 2, (size[1] - 1) / 2]
    matrix = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return {"size": size, "K": matrix, "R": rotation, "t": -rotation @ center}


def write_calibration(file, cameras):
    """Write cameras in Anipose's form."""
    tables = ""
    for number, (name, camera) in enumerate(cameras.items()):
        turn = cv2.Rodrigues(camera["R"])[0].ravel().tolist()
        tables += (
            f'[cam_{number}]\nname = "{name}"\nsize = {list(camera["size"])}\n'
            f"matrix = {camera['K'].tolist()}\ndistortions = [0.0, 0.0, 0.0, 0.0, 0.0]\n"
            f"rotation = {turn}\ntranslation = {camera['t'].tolist()}\n\n"
        )
    file.write_text(tables)


def write_poses(folder, cameras, joints):
    """Write COCO keypoint results of true joints and noise, in files with names in capitals."""
    folder.mkdir()
    random = np.random.default_rng(1)
    for name, camera in cameras.items():
        seen = joints @ camera["R"].T + camera["t"]
        pixels = seen / seen[..., 2:] @ camera["K"].T
        points = pixels[..., :2] + NOISE_PX * random.standard_normal((*seen.shape[:-1], 2))
        results = [
            {
                "image_id": frame,
                "category_id": 1,
                "keypoints": np.c_[person, np.full(17, 0.9)].round(2).ravel().tolist(),
                "score": 0.9,
            }
            for frame, people in enumerate(points)
            for person in people
        ]
        (folder / f"{name}.JSON").write_text(json.dumps(results))


TINY = ("--scenario", "tiny", "--seed", 77, "--duration", 0.4, "--no-video")


def import_people(folder, joints, places, **lens):
    """Import calibration and 2D poses of five people who walk at the centre of the world."""
    folder.mkdir()
    joints[..., :2] -= joints[..., :2].mean(axis=(0, 1, 2))
    np.save(folder / "truth.npy", joints)
    cameras = {f"cam{n}": camera_at(*place, **lens) for n, place in enumerate(places)}
    write_calibration(folder / "calibration.toml", cameras)
    write_poses(folder / "poses", cameras, joints)
    given = ("--calibration", folder / "calibration.toml", "--detections", folder / "poses")
    name = ("--match-id", folder.name)
    succeed(
        "import", *given, "--fps", 25, "--out", folder / "match", *name, environment=NEW_PROCESS
    )


@pytest.fixture(scope="session")
def pitch(server, shared_folder):
    """Six static cameras with clicked markings."""

    def make(folder):
        folder.mkdir()
        simulate(folder, *TINY)
        travel(folder)

    return Journey(shared_folder("pitch", make))


@pytest.fixture(scope="session")
def hall(pitch, shared_folder):
    """Four calibrated cameras around people, no pitch, and a body file of the user's own.

    Only the first run names the body.
    """

    def make(folder):
        import_people(folder, np.load(pitch.folder / "truth.npy"), RING)
        (folder / "bodies").mkdir()
        save_body(folder / "bodies/mine.npz", replace(load_open_body(), name="mine"))
        bodies = ("--body-folder", folder / "bodies")
        travel(folder, *bodies, "--set", "body_fitting.body_model=mine")
        travel(folder, *bodies)

    return Journey(shared_folder("hall", make))


def test_static_cameras(pitch, tmp_path):
    pitch.report(tmp_path / "report.html")
    assert pitch.median_error(tmp_path / "out") < 0.05


def test_a_hall_without_a_pitch(hall, tmp_path):
    said = (hall.folder / "said.txt").read_text()
    assert "body_fitting.body_model=mine" in said
    assert " 0 computed" in said
    assert (
        library.open_run(hall.folder / "project", "hall")["body_fitting/clip"].attrs["body_model"]
        == "mine"
    )
    hall.report(tmp_path / "report.html")
    assert hall.median_error(tmp_path / "out") < 0.03


def test_a_second_match_does_not_replace_the_first_one_s_export(hall, pitch, tmp_path):
    file = hall.export("joints", tmp_path / "out") / "joints.npz"
    before = file.read_bytes()
    answer = pitch.command("export", "--format", "joints", "--out", tmp_path / "out")
    assert answer.code == 1
    assert str(tmp_path / "out") in answer.err
    assert file.read_bytes() == before


def test_two_cameras_on_a_mast(pitch, tmp_path):
    truth = np.load(pitch.folder / "truth.npy")
    import_people(tmp_path / "mast", truth, MAST, focal=2500.0)
    spec = tmp_path / "mast/match/match.yaml"
    spec.write_text(spec.read_text().replace("pitch: none\n", ""))  # they stand on a pitch
    mast = travel(tmp_path / "mast", accepted=4)
    assert "contradicts" not in (mast.folder / "said.txt").read_text()
    page = mast.report(tmp_path / "report.html")
    assert "<td>plane</td>" in page
    rows = mast.export("positions", tmp_path / "out") / "positions/clip.csv"
    with rows.open() as file:
        found = [
            (int(row["frame"]), float(row["x_m"]), float(row["y_m"]))
            for row in csv.DictReader(file)
        ]
    assert len(found) > 30
    hips = truth[:, :, 11:13, :2].mean(axis=2)
    off = [np.linalg.norm(hips[frame] - place, axis=-1).min() for frame, *place in found]
    # A foot is known within 6 cm in height, seen from 3 m above the ground at 33 m.
    assert np.median(off) < 0.06 * 33.0 / 3.0


def write_ten_bits(file):
    """Encode a video again with 10 bits per sample and a name in capitals."""
    draft = file.with_name("draft.mp4")
    with av.open(str(file)) as given, av.open(str(draft), "w") as target:
        source = given.streams.video[0]
        stream = target.add_stream("libx264", rate=source.average_rate, options={"crf": "16"})
        stream.width, stream.height = source.width, source.height
        stream.pix_fmt = "yuv420p10le"
        for frame in given.decode(source):
            target.mux(stream.encode(frame.reformat(format="yuv420p10le")))
        target.mux(stream.encode())
    draft.rename(file.with_suffix(".MP4"))
    file.unlink()


def test_a_broadcast_camera_alone_in_ten_bits(server, tmp_path):
    pan = ("--scenario", "broadcast-pan", "--seed", 2, "--duration", 0.2, "--cameras", 1)
    folder = tmp_path / "broadcast"
    folder.mkdir()
    simulate(folder, *pan)
    truth = read_camera(folder / "truth_camera.npz")
    remove_static_cameras(folder / "match")
    write_ten_bits(folder / "match/broadcast/clip.mp4")
    journey = travel(folder)
    assert "Broadcast camera" in journey.report(tmp_path / "report.html")
    journey.export("joints", tmp_path / "out")
    match = library.read_match(folder / "match").spec.match_id
    found = library.open_run(str(folder / "project"), match)["broadcast_calibration/clip"]
    turn = np.einsum("fij,fkj->fik", found.rotation.values, truth.cam_from_world.rotation)
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    # Images that are bytes of 16-bit samples give 0.3 m, 1.7 % and 6 mrad.
    assert np.linalg.norm(found.center.values - truth.center[0]) < 0.1
    assert np.abs(found.focal.values / truth.focal - 1.0).max() < 0.003
    assert angle.max() < 2e-3
