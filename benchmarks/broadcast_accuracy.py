"""Prints accuracy and coverage of broadcast cameras on simulated clips.

    worldpose simulate --scenario broadcast-pan --duration 30 --cameras 1 --no-stills --out A
    python benchmarks/broadcast_accuracy.py A [MORE ...] [--key-frames 1] [--without-m6]

People of the static cameras are emulated: the true joints, with an error per joint of a person of 1
cm for the whole clip and of 2 cm per frame. The first line of a clip has key frames and followed
points alone, the second the same turned onto the painted lines, the third all terms. Off: residuals
of painted lines, and of people by the mean over their keypoints, before and after the third step.
Rough: root mean square second differences of log focal length, k1 and k2. Regions: the share of
centers, of frames' cameras with the center, and of players' places in the image that are inside
their stated regions. The last lines have, over all clips, the median and the range of found and
stated errors: of the centre, and of players' places in the image (medians of each clip).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.calibration import BroadcastClip, calibrate_broadcast
from worldpose.broadcast_calibration.moving_camera import FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.normal_equations import point_row
from worldpose.broadcast_calibration.players import People
from worldpose.broadcast_calibration.priors import second_differences
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.uncertainty import Uncertainty
from worldpose.formats.challenge import read_camera
from worldpose.formats.joints_file import read_joints
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.footage import read_unit
from worldpose.ingest.match_folder import MatchFolder, read_match
from worldpose.pitch.template import PitchTemplate
from worldpose.video.files import VideoReader

LASTING, ANEW = 0.01, 0.02
SHARES = (0.5, 0.8, 0.95, 0.99)


def true_camera(folder: Path, size: tuple[int, int], clip: str) -> MovingCamera:
    """Return the true broadcast camera of one clip."""
    camera = read_camera(folder / "reference" / "cameras" / f"{clip}.npz", size)
    return MovingCamera.of(camera, camera.center[0], camera.principal_point[0])


def people_of(match: MatchFolder, joints: Floats, clip: str) -> People:
    """Return people with the static cameras' errors, and the clip detector's keypoints."""
    rng = np.random.default_rng(9)
    seen, _ = read_unit(match, clip)
    given = joints + ANEW * rng.standard_normal(joints.shape)
    given = given + LASTING * rng.standard_normal(joints.shape[1:])
    return People(given, seen.keypoints.astype(np.float64), match.spec.fps)


def feet_in_picture(true: MovingCamera, joints: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return players' places (frames, persons, 3) [m], and a mask of those inside the image."""
    feet = joints[:, :, 15:17].mean(axis=2)
    seen = true.camera.project(feet)
    return feet, np.asarray(((seen > 0.0) & (seen < true.image_size - 1.0)).all(axis=-1))


def errors(found: MovingCamera, true: MovingCamera, joints: Floats) -> str:
    """Return a clip's errors in words."""
    grid = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 5), np.linspace(0.1, 0.9, 5)), axis=-1)
    pixels = grid.reshape(-1, 2) * (true.image_size - 1.0)
    one, two = (each.camera.unproject(pixels).directions for each in (found, true))
    bearing = np.degrees(np.linalg.norm(one - two, axis=-1))
    turn = Rigid(found.rotation @ np.swapaxes(true.rotation, 1, 2), np.zeros(3)).rotvec
    feet, inside = feet_in_picture(true, joints)
    off = np.linalg.norm(found.camera.project(feet) - true.camera.project(feet), axis=-1)[inside]
    return (
        f"center {np.linalg.norm(found.center - true.center):.3f} m"
        f"  focal {100.0 * np.median(np.abs(found.focal / true.focal - 1.0)):.3f} %"
        f"  rotation {np.median(np.degrees(np.linalg.norm(turn, axis=-1))):.4f} deg"
        f"  bearing {np.median(bearing):.4f} deg"
        f"  ground {np.median(off):.2f} / {np.percentile(off, 95.0):.2f} px"
    )


def distances(
    found: MovingCamera, known: Uncertainty, true: MovingCamera, joints: Floats
) -> dict[str, Floats]:
    """Return squared errors over the covariance, as quantiles of a chi-square distribution."""
    shared = np.append(true.center - found.center, true.principal_point - found.principal_point)
    turn = Rigid(true.rotation @ np.swapaxes(found.rotation, 1, 2), np.zeros(3)).rotvec
    step = np.concatenate(
        [
            turn,
            np.log(true.focal / found.focal)[:, None],
            true.distortion - found.distortion,
            np.broadcast_to(shared, (len(found), len(shared))),
        ],
        axis=1,
    )
    center = shared[:3] @ np.linalg.solve(known.clip[:3, :3], shared[:3])
    # k3 is not judged: no simulated lens has it.
    judged = np.delete(np.arange(step.shape[1]), FRAME_SIZE - 1)
    whole = known.frame[:, judged[:, None], judged]
    frame = np.einsum(
        "ti,ti->t", step[:, judged], np.linalg.solve(whole, step[:, judged, None])[..., 0]
    )
    feet, inside = feet_in_picture(true, joints)
    pixel, rows, places = np.empty(2), np.empty((2, 12)), []
    for t in range(0, len(found), 5):
        for place in feet[t, inside[t]]:
            point_row(found.rotation[t], found.center, found.lens(t), place, pixel, rows)
            off = true.camera[t].project(place[None])[0] - pixel
            places.append(off @ np.linalg.solve(rows @ known.frame[t] @ rows.T, off))
    return {
        "centers": chi2.cdf([center], 3),
        "cameras": chi2.cdf(frame, len(judged)),
        "places": chi2.cdf(places, 2),
    }


def stated_errors(
    found: MovingCamera, known: Uncertainty, true: MovingCamera, joints: Floats
) -> dict[str, tuple[float, float]]:
    """Return found and stated errors of the centre [m] and of players' places [px].

    Stated is the root of the mean squared distance for the centre, and for places the median
    distance of a normal distribution in the plane with their median variance.
    """
    feet, inside = feet_in_picture(true, joints)
    off = np.linalg.norm(found.camera.project(feet) - true.camera.project(feet), axis=-1)
    pixel, rows, spread = np.empty(2), np.empty((2, 12)), []
    for t in range(0, len(found), 5):
        for place in feet[t, inside[t]]:
            point_row(found.rotation[t], found.center, found.lens(t), place, pixel, rows)
            spread.append(np.trace(rows @ known.frame[t] @ rows.T))
    return {
        "centre [m]": (
            float(np.linalg.norm(found.center - true.center)),
            float(np.sqrt(np.trace(known.clip[:3, :3]))),
        ),
        "ground [px]": (
            float(np.median(off[inside])),
            float(np.sqrt(np.log(2.0) * np.median(spread))),
        ),
    }


def main() -> None:
    """Print two lines per clip, and the regions of all together."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("matches", nargs="+", type=Path)
    parser.add_argument("--key-frames", type=int, default=0, help="of each clip's; 0 = all")
    parser.add_argument("--without-players", action="store_true")
    parser.add_argument(
        "--without-m6", action="store_true", help="neither smoothness nor followed points"
    )
    options = parser.parse_args()
    settings = BroadcastCalibrationSettings()
    if options.without_m6:
        settings = settings.model_copy(update={"smooth": False, "flow_weight": 0.0})
    told: dict[str, list[Floats]] = {}
    both: dict[str, list[tuple[float, float]]] = {}
    for folder in options.matches:
        match = read_match(folder)
        for clip in (each.id for each in match.spec.clips if each.id in match.key_frames):
            keys = match.key_frames[clip].key_frames
            count = options.key_frames or len(keys)
            chosen = [keys[int((i + 0.5) * len(keys) / count)] for i in range(count)]
            camera = match.spec.camera(match.spec.clip(clip).broadcast or "")
            true = true_camera(folder, (camera.width, camera.height), clip)
            joints = read_joints(folder / "reference" / "joints.npz").joints
            people = people_of(match, joints, clip)

            def pictures(file: Path = match.videos[clip]) -> Iterator[NDArray[np.uint8]]:
                with VideoReader(file) as video:
                    yield from (picture for _, picture in video.frames(grey=True))

            assert match.pitch is not None  # of every scenario with a broadcast camera
            begin = time.perf_counter()
            found = calibrate_broadcast(
                PitchTemplate.from_spec(match.pitch),
                BroadcastClip(
                    chosen,
                    pictures,
                    match.spec.fps,
                    people=None if options.without_players else people,
                    boxes=people.boxes,
                ),
                settings,
            )
            spent = time.perf_counter() - begin
            print(f"{folder.name}: {len(true)} frames, {count} key frames, {spent:.0f} s")
            print(f"  tracked  {errors(found.tracked, true, joints)}")
            print(f"  lines    {errors(found.before, true, joints)}")
            print(f"  all      {errors(found.camera, true, joints)}")
            for name in ("markings_off", "players_off"):
                print(
                    "  {} {:.3f} px before, {:.3f} after".format(name, *getattr(found.report, name))
                )
            spreads = np.sqrt((second_differences(found.camera) ** 2).mean(axis=0))
            rough = "  ".join(f"{value:.3g}" for value in spreads[3:6])
            print(f"  rough    {rough}", flush=True)
            for name, shares in distances(found.camera, found.uncertainty, true, joints).items():
                told.setdefault(name, []).append(shares)
                print(f"  {name}: inside the region of {np.median(shares):.3f} in the median")
            stated = stated_errors(found.camera, found.uncertainty, true, joints)
            for name, pair in stated.items():
                both.setdefault(name, []).append(pair)
                print("  {}: found {:.3f}, stated {:.3f}".format(name, *pair), flush=True)
    for name, parts in told.items():
        held = [100.0 * np.mean([(part < share).mean() for part in parts]) for share in SHARES]
        wanted = " / ".join(f"{100.0 * share:g}" for share in SHARES)
        print(f"{name} in regions of {wanted} %: " + " / ".join(f"{each:.1f}" for each in held))
    for name, pairs in both.items():
        for kind, values in zip(("found", "stated"), np.transpose(pairs), strict=True):
            middle, low, high = np.median(values), values.min(), values.max()
            print(f"{name} {kind} in {len(values)} clips: {middle:.3f} ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
