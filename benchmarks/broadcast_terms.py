"""Prints the contribution of each term to the broadcast camera's fit: markings, players, motion.

    python benchmarks/broadcast_terms.py broadcast-pan --seeds 61 62 63 --survey-error 0.03

Rows: every frame turned and zoomed onto its painted lines; all frames by painted lines; those and
players; those and even, followed motion; all; and the true camera. Columns: median residuals of
painted lines and people [px], people by the mean over their keypoints; true feet in the image,
median and 95 % [px]. The true camera's residuals are the errors of the survey and the detector:
smaller line residuals are a fit to those errors.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from broadcast_accuracy import feet_in_picture, people_of, true_camera
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.calibration import BroadcastClip, refine, track
from worldpose.broadcast_calibration.evidence import join_evidence
from worldpose.broadcast_calibration.line_evidence import FieldSamples, follow_lines
from worldpose.broadcast_calibration.pitch_errors import PitchErrors
from worldpose.broadcast_calibration.players import match as match_players
from worldpose.broadcast_calibration.players import player_evidence
from worldpose.broadcast_calibration.report import median_residuals
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.formats.joints_file import JointTracks, read_joints
from worldpose.ingest.match_folder import read_match
from worldpose.pitch.template import PitchTemplate
from worldpose.reports.broadcast import largest_pose_changes, plot_before_after
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.video.files import VideoReader

STILL = {"smooth": False, "flow_weight": 0.0}
TERMS: dict[str, dict[str, float]] = {
    "lines": {"player_weight": 0.0, **STILL},
    "lines, players": STILL,
    "lines, motion": {"player_weight": 0.0},
    "all": {},
}


def rows_of(
    folder: Path, whole: BroadcastCalibrationSettings, picture: Path | None
) -> dict[str, Floats]:
    """Return lines, people and feet, median and 95 % (4,) [px], of every variant of a clip's fit.

    The image shows the person with the largest change by the players' term, before and after.
    """
    match = read_match(folder)
    (clip,) = match.key_frames
    camera = match.spec.camera(match.spec.clip(clip).broadcast or "")
    true = true_camera(folder, (camera.width, camera.height), clip)
    joints = read_joints(folder / "reference" / "joints.npz").joints
    people = people_of(match, joints, clip)
    assert match.pitch is not None  # of every scenario with a broadcast camera
    pitch = PitchTemplate.from_spec(match.pitch)

    def pictures(file: Path = match.videos[clip]) -> Iterator[NDArray[np.uint8]]:
        with VideoReader(file) as video:
            yield from (picture for _, picture in video.frames(grey=True))

    keys = match.key_frames[clip].key_frames
    given = BroadcastClip(keys, pictures, match.spec.fps, people, where=str(folder))
    tracked = track(pitch, given, whole)
    fits = {}
    for name, changes in TERMS.items():
        settings = whole.model_copy(update=changes)
        fits[name] = refine(pitch, given, tracked, settings)
    found = {
        "frame by frame": fits["all"].before,
        **{name: fit.camera for name, fit in fits.items()},
        "true camera": true,
    }
    # The same lines and people for all variants, searched around the true camera.
    samples = FieldSamples.of(pitch, PitchErrors.of(pitch, whole), pitch.surface)
    lines = follow_lines(true, samples, pictures(), people.boxes, whole)
    players, _ = player_evidence(true, people, match_players(true, people), whole)
    evidence = join_evidence([lines.evidence, players])
    feet, inside = feet_in_picture(true, joints)
    at = true.camera.project(feet)
    rows = {}
    for name, each in found.items():
        off = np.linalg.norm(each.camera.project(feet) - at, axis=-1)[inside]
        rows[name] = np.array(
            [*median_residuals(each, evidence), np.median(off), np.percentile(off, 95.0)]
        )
    if picture is not None:
        before, after = fits["all"].before.camera, fits["all"].camera.camera
        number = np.arange(joints.shape[1])
        tracks = JointTracks(np.arange(len(joints)), number, joints)
        frame, person = largest_pose_changes(before, after, tracks)
        with VideoReader(match.videos[clip]) as video:
            still = video.frame(frame)
        seen = people.keypoints[frame, :, :, :2]
        drawn = plot_before_after(
            before[frame], after[frame], tracks, frame, person,
            still=still, seen=seen, pitch=match.pitch,
        )  # fmt: skip
        picture.write_bytes(drawn)
    return rows


def main() -> None:
    """Print a table for each clip and one of the means of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenario", help="with clicked key frames, filmed for 3 s")
    parser.add_argument("--seeds", nargs="+", type=int, default=[61, 62, 63])
    parser.add_argument("--survey-error", type=float, default=0.006, help="which is stated [m]")
    parser.add_argument("--picture", type=Path, help="PNG to write, of the first seed")
    options = parser.parse_args()
    settings = BroadcastCalibrationSettings(survey_error_m=options.survey_error)
    scenario = SCENARIOS[options.scenario].model_copy(update={"survey_error": options.survey_error})
    tables = {}
    for seed in options.seeds:
        picture = options.picture if seed == options.seeds[0] else None
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "clip"
            simulate_match(
                scenario, seed, folder, MatchOptions(duration=3.0, cameras=1, stills=False)
            )
            tables[f"seed {seed}"] = rows_of(folder, settings, picture)
    names = list(next(iter(tables.values())))
    tables["mean"] = {
        name: np.mean([each[name] for each in tables.values()], axis=0) for name in names
    }
    for title, rows in tables.items():
        print(f"{title:20s}  lines  people  feet, 95 % [px]")
        for name, row in rows.items():
            print("  {:18s}  {:5.3f}  {:5.2f}   {:5.2f}  {:5.2f}".format(name, *row), flush=True)


if __name__ == "__main__":
    main()
