"""The paper's ablation of bundle adjustment, on trials of two simulators with known truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.body.body_file import find_body
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.results import BodyFit, ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.bundle_adjustment.clip import Clicks, Clip
from worldpose.bundle_adjustment.estimate import adjust_cameras
from worldpose.bundle_adjustment.report import marking_errors
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.errors import InputError
from worldpose.evaluation.cameras import evaluate_cameras
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method import require_torch
from worldpose.simulation.foreign.matches import simulate_foreign_scene
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import ClickSettings, MatchOptions
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.results import Triangulation
from worldpose.triangulation.settings import TriangulationSettings

CLICKS: Final[Mapping[str, ClickSettings | None]] = {
    "few clicks": ClickSettings(
        clustered=1.0, window=0.35, clustered_points=(5, 6), noise_px=1.5, wrong=0.0
    ),
    "many clicks": ClickSettings(),
    "second world": None,
}
"""Five or six clicks in a third of the image with 1.5 px noise; eight to twelve all over it with
1 px noise, some of them wrong; the second simulator's own, eight to seventeen."""

PAPER: Final = {
    "base": (83.5, 70.8),
    "+ BA, S and P": (86.2, 70.7),
    "+ BA, S, unguarded": (548.4, 75.4),
    "+ BA + SMPL": (80.0, 66.3),
}
"""G-MPJPE and PA-MPJPE of the paper's table [mm]."""

BY_PAPER: Final = ", the paper's method"
"""End of the names of rows that `worldpose.reference_method` computes."""

_OURS: Final = TriangulationSettings()


@dataclass(frozen=True)
class Score:
    """Metrics of one row of one trial.

    Attributes:
        g_mpjpe_mm: mean joint distance after one alignment of all people [mm].
        pa_mpjpe_mm: mean joint distance after alignment of each pose [mm].
        ground_error_m: median over the part of the pitch that the cameras see [m].
        marking_error_px: residual of the clicks used for calibration, mean over cameras [px].
        changed: share of cameras that the adjustment changed [1].
    """

    g_mpjpe_mm: float
    pa_mpjpe_mm: float
    ground_error_m: float
    marking_error_px: float
    changed: float


class Trial(NamedTuple):
    """A simulated trial: its truth, and what a user has of it, by camera."""

    fps: float
    truth: JointTracks
    cameras: Mapping[str, Camera]
    clicked: Mapping[str, ClickedMarkings]
    observations: Mapping[str, KeypointDetections]
    painted: PitchSpec
    surveyed: PitchSpec


def simulate(seed: int, clicks: ClickSettings | None) -> Trial:
    """Return a trial like the paper's, of 2 s, 6 players close together and 10 cameras.

    Without clicks it is of the second simulator, with synchronised cameras that are to be clicked.
    """
    if clicks is not None:
        scenario = SCENARIOS["penalty-box"].model_copy(update={"clicks": clicks})
        own = simulate_scene(scenario, seed)
        clicked = {name: each.markings for name, each in own.clicks.items()}
        seen = {name: own.observations[name] for name in own.cameras}
        pitches = scenario.pitch, own.surveyed
        return Trial(scenario.fps, own.truth, own.cameras, clicked, seen, *pitches)
    close = {"given": 0.0, "unsynchronised": 0.0, "area": (0.08, 0.13)}
    kind = FOREIGN_SCENARIOS["foreign-match"].model_copy(update=close)
    options = MatchOptions(duration=2.0, cameras=10, players=6)
    scene = simulate_foreign_scene(kind, seed, options)
    assert scene.pitch is not None
    cameras = {name: each.camera for name, each in scene.cameras.items()}
    seen = {name: each.observations for name, each in scene.reports.items()}
    pitches = scene.pitch.painted, scene.pitch.stated
    return Trial(scene.fps, scene.truth, cameras, scene.clicked, seen, *pitches)


def trial(seed: int, clicks: ClickSettings | None) -> dict[str, Score]:
    """Return the rows of one simulated trial by name; without clicks, of the second simulator.

    Base is calibration from clicks alone, without painted lines, as in the paper. `S only` frees
    the whole lens and drops the camera priors, as is common practice; the rows `unguarded` show its
    result without held-out validation. Every row is triangulated from the same tracks; the last one
    fits bodies to our triangulation after adjustment. Rows that end with `BY_PAPER` are the four of
    the paper by its own method (table of the Vicon trial).
    """
    scene = simulate(seed, clicks)
    pitch = PitchTemplate.from_spec(scene.surveyed)
    calibrations = _calibrate_cameras(scene, pitch)
    clip = _clip(scene, calibrations, pitch)
    true = Camera.stack([scene.cameras[name] for name in calibrations])
    both = adjust_cameras(clip)
    markings = adjust_cameras(clip, BundleAdjustmentSettings(evidence="markings"))
    everyone = np.ones(len(calibrations), dtype=np.bool_)
    rows = {
        "true cameras": (true, ~everyone),
        "base": (clip.cameras, ~everyone),
        "+ BA, S and P": (both.cameras, both.accepted),
        "+ BA, S only": (markings.cameras, markings.accepted),
        "+ BA, S, unguarded": (markings.refused, everyone),
    }
    names = tuple(calibrations)
    scores = {}
    for name, (cameras, changed) in rows.items():
        joints = triangulate_joints(cameras, clip.detections, _OURS).joints
        scores[name] = _score(scene, clip, names, cameras, changed, joints)
    placed = triangulate_joints(both.cameras, clip.detections, _OURS, both.covariance)
    scores["+ BA + SMPL"] = _score(
        scene, clip, names, both.cameras, both.accepted, _fit(scene, clip, placed)
    )
    return scores | _by_paper(scene, clip, calibrations, pitch)


def ablation(
    seeds: Sequence[int], progress: Callable[[str, int], None]
) -> dict[str, list[dict[str, Score]]]:
    """Return the trials of all seeds, by click settings; report each by these and its seed."""
    trials: dict[str, list[dict[str, Score]]] = {name: [] for name in CLICKS}
    for name, settings in CLICKS.items():
        for seed in seeds:
            trials[name].append(trial(seed, settings))
            progress(name, seed)
    return trials


def _calibrate_cameras(scene: Trial, pitch: PitchTemplate) -> dict[str, StaticCalibration]:
    """Calibrate the cameras whose clicks determine them; skip the others."""
    found = {}
    for name, camera in scene.cameras.items():
        size = (int(camera.image_size[0]), int(camera.image_size[1]))
        settings = StaticCalibrationSettings(lines=False)
        try:
            found[name] = calibrate_camera(
                pitch, scene.clicked[name], size, settings=settings, where=name
            )
        except InputError:
            continue
    return found


def _clip(
    scene: Trial, calibrations: Mapping[str, StaticCalibration], pitch: PitchTemplate
) -> Clip:
    """Track and triangulate the trial with the base cameras; return bundle adjustment's input."""
    seen = KeypointDetections.stack([scene.observations[name] for name in calibrations])
    points, sure = seen.keypoints.astype(np.float64), seen.confidence.astype(np.float64)
    seen = KeypointDetections.from_keypoints(points, sure, frame=seen.frame)
    cameras = Camera.stack([known.estimate.camera for known in calibrations.values()])
    tracks = track_people(cameras, seen, scene.fps, TrackingSettings())
    detections = seen.assign_people(tracks.detection_index)
    placed = triangulate_joints(cameras, detections, _OURS)
    return Clip(
        cameras=cameras,
        covariance=np.stack([known.estimate.covariance for known in calibrations.values()]),
        clicks=tuple(Clicks.of(known, pitch) for known in calibrations.values()),
        fps=scene.fps,
        detections=detections,
        joints=placed.joints,
        views=placed.views.astype(np.int64),
        triangulation=_OURS,
    )


def _by_paper(
    scene: Trial, clip: Clip, known: Mapping[str, StaticCalibration], pitch: PitchTemplate
) -> dict[str, Score]:
    """Return the paper's four rows by its own method, from the same tracks.

    Its first row has stages 1 and 2 of each camera; there are no images for stage 3. A camera that
    stage 1 does not determine starts stage 2 from ours.
    """
    require_torch()
    from worldpose.reference_method.static_calibration import calibrate
    from worldpose.triangulation.paper_variant import place_joints

    def calibrate_one(ours: StaticCalibration) -> Camera:
        try:
            return calibrate(ours, pitch).estimate.camera
        except InputError:
            return calibrate(ours, pitch, start=ours.estimate.camera).estimate.camera

    first = list(map(calibrate_one, known.values()))
    base, none = replace(clip, cameras=Camera.stack(first)), np.zeros(len(known))
    settings = BundleAdjustmentSettings(method="paper")
    both = adjust_cameras(base, settings)
    marks = adjust_cameras(base, settings.model_copy(update={"evidence": "markings"}))
    rows = {
        "base": (base.cameras, none),
        "+ BA, S and P": (both.cameras, both.accepted),
        "+ BA, S, unguarded": (marks.cameras, marks.accepted),
    }
    scores, joints = {}, {}
    for name, (cameras, changed) in rows.items():
        start = triangulate_joints(cameras, clip.detections, _OURS).joints
        joints[name] = place_joints(cameras, clip.detections, start, about_mid_hip=False)
        scores[name + BY_PAPER] = _score(scene, clip, tuple(known), cameras, changed, joints[name])
    bodies = _fit_as_paper(clip, both.cameras, joints["+ BA, S and P"])
    scores["+ BA + SMPL" + BY_PAPER] = _score(
        scene, clip, tuple(known), both.cameras, both.accepted, bodies
    )
    return scores


def _fit_as_paper(clip: Clip, cameras: Camera, joints: Floats) -> Floats:
    """Return the joints of the paper's bodies, of the open body."""
    from worldpose.body_fitting.paper_variant import fit_in_windows

    settings = BodyFittingSettings(method="paper")
    evidence = ClipEvidence(joints, np.zeros((*joints.shape, 3)), clip.fps)
    seen = (cameras, clip.detections)
    parts = fit_in_windows(find_body(settings.body_model), evidence, seen, settings, {})
    return BodyFit.concatenate([fit for _, fit in parts]).joints


def _fit(scene: Trial, clip: Clip, placed: Triangulation) -> Floats:
    """Return the joints of our bodies."""
    how = BodyFittingSettings()
    floor = PitchTemplate.from_spec(scene.surveyed).height
    evidence = ClipEvidence(placed.joints, placed.covariance, clip.fps, placed.common_bias)
    return fit_bodies(find_body(how.body_model), evidence, how, floor).joints


def _score(
    scene: Trial,
    clip: Clip,
    names: tuple[str, ...],
    cameras: Camera,
    changed: np.ndarray,
    joints: Floats,
) -> Score:
    """Score cameras, and joints (frames, persons, 17, 3) [m] that were placed with them."""
    tracks = JointTracks(clip.detections.frame, np.arange(joints.shape[1]), joints)
    found, _ = evaluate_joints(tracks, scene.truth, fps=clip.fps)
    estimated = {name: cameras[c] for c, name in enumerate(names)}
    pitch = PitchTemplate.from_spec(scene.painted)
    errors, _ = evaluate_cameras(estimated, scene.cameras, pitch)
    ground = None if errors is None or errors.static is None else errors.static
    return Score(
        g_mpjpe_mm=_number(found.g_mpjpe_mm),
        pa_mpjpe_mm=_number(found.pa_mpjpe_mm),
        ground_error_m=_number(None if ground is None else ground.ground_error_median_m),
        marking_error_px=float(np.nanmean(marking_errors(clip, cameras))),
        changed=float(changed.mean()),
    )


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
