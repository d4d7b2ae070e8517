"""Accuracy and coverage of cameras in simulation: static and moving."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import places_of_feet, quantile, simulate, tell
from registry import Table, Tables, benchmark, integer, option
from scipy.stats import chi2

from data_contracts.arrays import Flags, Floats, Image
from worldpose.broadcast_calibration.estimate import BroadcastClip, calibrate_broadcast
from worldpose.broadcast_calibration.moving_camera import FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.players import People
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.uncertainty import Uncertainty
from worldpose.errors import InputError
from worldpose.evaluation.cameras import surface_points
from worldpose.formats.joints_file import read_joints
from worldpose.formats.release_cameras import read_camera
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.footage import read_unit
from worldpose.ingest.match_folder import MatchFolder, read_match
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.parameters import CameraEstimate, step_between
from worldpose.video.files import VideoReader

SHARES = (0.5, 0.8, 0.95, 0.99)

GROUND = ("number", "median [cm]", "95 % [cm]", *(f"in {100 * s:g} % regions [%]" for s in SHARES))


LASTING, ANEW = 0.01, 0.02


@benchmark(
    "static_accuracy",
    "static cameras from clicks and from lines: ground error, wrong clicks, coverage",
    option("scenarios", nargs="*", default=["match", "penalty-box", "sparse-corner"]),
    integer("surveys", 19),
    integer("first", 0, "seed of the first survey"),
)
def score_static_cameras(options: Namespace) -> Tables:
    """Clicks, mistakes and errors of the survey are the scenario's own; one image per camera.

    Ground: the true pixel of a player's place, back through the estimated camera onto the pitch,
    median and 95 %. Wrong clicks: recall and precision of calibration from clicks. Regions: share
    of cameras inside their stated region.
    """
    rows, clicks = [], []
    for scenario in options.scenarios:
        every = []
        for each in outcomes(scenario, range(options.first, options.first + options.surveys)):
            every.append(each)
            tell(f"{scenario}: {len(every)} cameras")
        cameras = [each for each in every if each is not None]
        for stage, label in enumerate(("from clicks", "with lines")):
            errors = 100.0 * np.concatenate([each.ground[stage] for each in cameras])
            inside = [[each.region[stage] < share for each in cameras] for share in SHARES]
            held = [100.0 * float(np.mean(each)) for each in inside]
            row = [f"{scenario}, {label}", len(cameras), quantile(errors), quantile(errors, 0.95)]
            rows.append([*row, *held])
        wrong, named = (sum(len(getattr(c, n)) for c in cameras) for n in ("wrong", "named"))
        right = sum(len(each.wrong & each.named) for each in cameras)
        look = 100.0 * float(np.mean([each.weak for each in cameras]))
        refined = sum(each.refined for each in cameras)
        refused = len(every) - len(cameras)
        clicks.append([scenario, refused, refined, wrong, right, named - right, look])
    columns = ["scenario", "refused", "with lines", "wrong clicks", "named", "others named"]
    return {
        "ground": Table("ground error, and share inside regions", ["cameras", *GROUND], rows),
        "clicks": Table("cameras and clicks", [*columns, "asks for a look [%]"], clicks),
    }


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of one camera.

    Attributes:
        ground: errors at the players from clicks, and with lines [m].
        region: probability mass of the estimate's distribution nearer than the true camera, for
            both.
        wrong: names of wrong clicks.
        named: names of clicks that calibration reported as wrong.
        weak: whether the report asks for a user's check, from clicks.
        refined: whether lines contributed to the camera.
    """

    ground: tuple[Floats, ...]
    region: tuple[float, ...]
    wrong: frozenset[str]
    named: frozenset[str]
    weak: bool
    refined: bool


def ground_errors(found: Camera, true: Camera, places: Floats, pitch: PitchTemplate) -> Floats:
    """Return the distance between places and the back-projections of their true pixels [m]."""
    pixels = true.project(places)
    seen = ((pixels > 0.0) & (pixels < true.image_size - 1.0)).all(axis=-1)
    met = surface_points(found.unproject(pixels[seen]), pitch)
    off = np.linalg.norm(met - places[seen], axis=-1)
    return np.asarray(np.where(np.isfinite(off), off, np.hypot(pitch.length, pitch.width)))


def region(estimate: CameraEstimate, true: Camera) -> float:
    """Return the estimate's probability mass that is nearer to it than the true camera."""
    step = step_between(estimate.camera, true)
    free = np.diag(estimate.covariance) > 0.0
    inner = estimate.covariance[np.ix_(free, free)]
    squared = step[free] @ np.linalg.solve(inner, step[free])
    return float(chi2.cdf(squared, free.sum()))


def outcomes(scenario: str, seeds: range) -> Iterator[Outcome | None]:
    """Yield the cameras of some surveys, None for a camera that calibration refuses."""
    for seed in seeds:
        settings, scene = simulate(scenario, seed, 0.2)
        painted = PitchTemplate.from_spec(settings.pitch)
        surveyed = PitchTemplate.from_spec(scene.surveyed)
        places = places_of_feet(scene.truth.joints[::3], painted)
        for name, true in scene.cameras.items():
            clicks = scene.clicks[name]
            size = (int(true.image_size[0]), int(true.image_size[1]))
            still = render_pitch(true, painted, scene.poses[:, 0], seed)
            try:
                found = [
                    calibrate_camera(surveyed, clicks.markings, size, picture=each)
                    for each in (None, still)
                ]
            except InputError:
                yield None
                continue
            yield Outcome(
                ground=tuple(
                    ground_errors(each.estimate.camera, true, places, painted) for each in found
                ),
                region=tuple(region(each.estimate, true) for each in found),
                wrong=frozenset(clicks.wrong),
                named=frozenset(found[0].report.wrong),
                weak=found[0].report.weak,
                refined=found[1].report.stage == "lines",
            )


@benchmark(
    "broadcast_accuracy",
    "moving cameras of simulated clips: errors after each step, coverage",
    option("matches", nargs="+", type=Path, help="of `worldpose simulate --scenario broadcast-*`"),
)
def score_moving_cameras(options: Namespace) -> Tables:
    """`worldpose simulate --scenario broadcast-pan --duration 30 --cameras 1 --no-stills --out A`.

    People of the static cameras are emulated: the true joints, with an error per joint of a person
    of 1 cm for the whole clip and of 2 cm per frame. Tracked: key frames and followed points;
    lines: turned onto the painted lines; all: all terms. Regions: share of centres, of frames'
    cameras with the centre, and of players' places in the image inside their stated regions.
    """
    settings = BroadcastCalibrationSettings()
    told: dict[str, list[Floats]] = {}
    rows, stated = [], []
    for folder in options.matches:
        match = read_match(folder)
        for clip in match.key_frames:
            camera = match.spec.broadcast_views[clip].camera
            true = true_camera(folder, (camera.width, camera.height), clip)
            joints = read_joints(folder / "reference" / "joints.npz").joints
            people = people_of(match, joints, clip)

            def pictures(file: Path = match.videos[clip]) -> Iterator[Image]:
                with VideoReader(file) as video:
                    yield from (picture for _, picture in video.frames(grey=True))

            keys = list(match.key_frames[clip].key_frames)
            assert match.pitch is not None  # of every scenario with a broadcast camera
            given = BroadcastClip(keys, pictures, match.spec.fps, people=people, boxes=people.boxes)
            found = calibrate_broadcast(PitchTemplate.from_spec(match.pitch), given, settings)
            steps = {"tracked": found.tracked, "lines": found.before, "all": found.camera}
            for label, each in steps.items():
                rows.append([f"{folder.name}, {label}", *errors_of(each, true, joints)])
            for name, shares in distances(found.camera, found.uncertainty, true, joints).items():
                told.setdefault(name, []).append(shares)
            spread = float(np.sqrt(np.trace(found.uncertainty.clip[:3, :3])))
            pixels = quantile(found.report.reprojection_error)
            stated.append([folder.name, spread, pixels, *found.report.markings_off])
    held = [
        [name, *(100.0 * np.mean([(part < share).mean() for part in parts]) for share in SHARES)]
        for name, parts in told.items()
    ]
    columns = ["clip", "centre [m]", "focal [%]", "rotation [deg]", "bearing [deg]"]
    clips = ["clip", "centre [m]", "image [px]", "lines before [px]", "lines after [px]"]
    return {
        "errors": Table("errors", [*columns, "places [px]", "places, 95 % [px]"], rows),
        "stated": Table("stated errors, and residuals of the lines", clips, stated),
        "regions": Table("inside regions [%]", ["of", *map(str, SHARES)], held),
    }


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


def feet_in_picture(true: MovingCamera, joints: Floats) -> tuple[Floats, Flags]:
    """Return players' places (frames, persons, 3) [m], and a mask of those inside the image."""
    feet = joints[:, :, 15:17].mean(axis=2)
    seen = true.camera.project(feet)
    return feet, np.asarray(((seen > 0.0) & (seen < true.image_size - 1.0)).all(axis=-1))


def errors_of(found: MovingCamera, true: MovingCamera, joints: Floats) -> list[float]:
    """Return errors of centre, focal length, rotation, bearing and players' places."""
    grid = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 5), np.linspace(0.1, 0.9, 5)), axis=-1)
    pixels = grid.reshape(-1, 2) * (true.image_size - 1.0)
    one, two = (each.camera.unproject(pixels).directions for each in (found, true))
    bearing = np.degrees(np.linalg.norm(one - two, axis=-1))
    turn = Rigid(found.rotation @ np.swapaxes(true.rotation, 1, 2), np.zeros(3)).rotvec
    feet, inside = feet_in_picture(true, joints)
    off = np.linalg.norm(found.camera.project(feet) - true.camera.project(feet), axis=-1)[inside]
    return [
        float(np.linalg.norm(found.center - true.center)),
        100.0 * quantile(np.abs(found.focal / true.focal - 1.0)),
        quantile(np.degrees(np.linalg.norm(turn, axis=-1))),
        quantile(bearing),
        quantile(off),
        quantile(off, 0.95),
    ]


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
    places = []
    for t in range(0, len(found), 5):
        pixels, slopes = found.project_with_jacobian(t, feet[t, inside[t]])
        for off, rows in zip(
            true.camera[t].project(feet[t, inside[t]]) - pixels, slopes, strict=True
        ):
            places.append(off @ np.linalg.solve(rows @ known.frame[t] @ rows.T, off))
    return {
        "centers": chi2.cdf([center], 3),
        "cameras": chi2.cdf(frame, len(judged)),
        "places": chi2.cdf(places, 2),
    }
