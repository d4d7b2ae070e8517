"""Prints the coverage of broadcast cameras' confidence regions, on many emulated clips.

    python benchmarks/broadcast_regions.py --seeds 106 107 108 109 110 [--seconds 30]

Nothing is rendered: painted lines are emulated with 0.15 px of noise, the survey's errors and a
shift of the whole image; people are those of the simulated detector, and joints as in
broadcast_accuracy.py. There are no followed points. Scenarios broadcast-pan and broadcast-zoom of
every seed.
"""

from __future__ import annotations

import argparse

import numpy as np
from broadcast_accuracy import ANEW, LASTING, SHARES, distances, errors

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.evidence import (
    MARKING,
    FlowEvidence,
    ObservedPoints,
    PointEvidence,
    join_evidence,
)
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.players import People, match, player_evidence
from worldpose.broadcast_calibration.priors import (
    build_prior,
    correlation_time,
    estimate_smoothness,
)
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.solver import Problem, solve
from worldpose.broadcast_calibration.uncertainty import compute_uncertainty
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.line_samples import (
    EXACT_PAINT,
    LineSamples,
    project_lines,
    sample_markings,
    thin_samples,
)

NOISE = 0.15
"""Noise of a line's sample [px]."""


def lines_of(
    true: MovingCamera,
    samples: LineSamples,
    settings: BroadcastCalibrationSettings,
    rng: np.random.Generator,
) -> PointEvidence:
    """Return emulated detections of painted lines in every frame."""
    painted = rng.standard_normal((int(samples.ends.max()) + 1, 3))
    shift = settings.line_shift_px * rng.standard_normal(2)
    parts = []
    for frame in range(len(true)):
        camera = true.camera[frame]
        seen = project_lines(camera, samples, 0.12, EXACT_PAINT)
        index = thin_samples(seen, samples, 4.0, settings.line_samples)
        world, ends = samples.points_world[index], samples.ends[index]
        shares = settings.survey_error_m * samples.shares[index]
        hung = np.where(ends[..., None] >= 0, shares[..., None] * painted[ends], 0.0)
        pixels = camera.project(world + hung.sum(axis=1)) + shift
        parts.append(
            PointEvidence.across_lines(
                ObservedPoints(
                    frame=np.full(len(index), frame),
                    world=world,
                    image=pixels + NOISE * rng.standard_normal(pixels.shape),
                    kind=MARKING,
                    source=samples.marking[index],
                    ends=ends,
                    shares=shares,
                ),
                seen.normals[index],
                np.full(len(index), np.hypot(NOISE, settings.line_noise_px)),
                settings.field_weight,
                settings.loss_scale,
            )
        )
    return join_evidence(parts)


def judge_clip(name: str, seed: int, seconds: float, fps: float) -> dict[str, Floats]:
    """Return an emulated clip's squared errors as quantiles of the regions' distribution."""
    settings = BroadcastCalibrationSettings()
    scenario = SCENARIOS[name]
    rig = scenario.rig.model_copy(update={"cameras": 1})
    scene = simulate_scene(
        scenario.model_copy(update={"duration": seconds, "fps": fps, "rig": rig}), seed
    )
    film, joints = scene.broadcast, scene.truth.joints
    assert film is not None  # the scenario has a broadcast camera
    true = MovingCamera.of(film, film.center[0], film.principal_point[0])
    rng = np.random.default_rng([seed, 77])
    given = joints + ANEW * rng.standard_normal(joints.shape)
    given = given + LASTING * rng.standard_normal(joints.shape[1:])
    people = People(given, scene.observations["clip"].keypoints.astype(np.float64), fps)
    samples = sample_markings(PitchTemplate.from_spec(scene.surveyed), 0.25)
    lines = lines_of(true, samples, settings, rng)
    players, _ = player_evidence(true, people, match(true, people), settings)
    problem = Problem(
        points=join_evidence([lines, players]),
        flow=FlowEvidence.none(),
        prior=build_prior(settings.prior, true.focal, true.image_size),
        smoothness=estimate_smoothness(true, fps),
    )
    solution = solve(true, problem, settings.max_iterations)
    lasting = correlation_time(true, fps)
    known = compute_uncertainty(
        solution, problem, settings.line_shift_px, settings.player_shift, lasting
    )
    print(f"{name} {seed}: {errors(solution.camera, true, joints)}", flush=True)
    return distances(solution.camera, known, true, joints)


def main() -> None:
    """Print one line per clip, and the coverage over all clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, required=True)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--fps", type=float, default=10.0)
    options = parser.parse_args()
    told: dict[str, list[list[float]]] = {}
    for seed in options.seeds:
        for name in ("broadcast-pan", "broadcast-zoom"):
            clip = judge_clip(name, seed, options.seconds, options.fps)
            for kind, shares in clip.items():
                held = [float((shares < share).mean()) for share in SHARES]
                told.setdefault(kind, []).append(held)
    wanted = " / ".join(f"{100.0 * share:g}" for share in SHARES)
    for kind, parts in told.items():
        found = " / ".join(f"{100.0 * each:.1f}" for each in np.mean(parts, axis=0))
        print(f"{kind} in regions of {wanted} %: {found}")


if __name__ == "__main__":
    main()
