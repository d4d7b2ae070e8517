"""Loading of predictions and references by name, and their scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from data_contracts.evaluation import Evaluation
from data_contracts.match import MatchSpec
from data_contracts.run import JOINT_STAGES
from flows.registering import find_match
from flows.results.best_results import clips_of, describe_age, joint_tracks, open_results
from flows.results.run_cameras import broadcast_cameras, static_cameras
from worldpose.dataset.benchmark import require_one_rate
from worldpose.dataset.manifest import stated_rate
from worldpose.errors import InputError, UsageError
from worldpose.evaluation.cameras import CameraScore, evaluate_cameras
from worldpose.evaluation.marker_reference import (
    SUFFIXES,
    ReferenceAlignment,
    align_reference,
    map_marker_names,
    marker_joints,
    read_marker_map,
    read_markers,
)
from worldpose.evaluation.metrics import PersonScore, drop_views, evaluate_joints
from worldpose.evaluation.position_reference import align_positions
from worldpose.formats.joints_file import JointTracks, read_joints
from worldpose.formats.release_cameras import read_camera
from worldpose.geometry.cameras import Camera
from worldpose.ingest.match_folder import MatchFolder, spec_around
from worldpose.ingest.pitch_file import read_pitch
from worldpose.pitch.template import PitchTemplate
from worldpose.store.runs import LATEST
from worldpose.store.store import Store

TABLES = (".csv", ".tsv", ".gz", ".zip")
"""Endings of tables of positions."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Metrics against ground truth: total, by true person, by camera."""

    evaluation: Evaluation
    people: tuple[PersonScore, ...]
    cameras: tuple[CameraScore, ...]
    alignment: ReferenceAlignment | None = None
    """Alignment of markers to the prediction, if markers are the ground truth."""
    age: str = ""
    """A sentence about a later run than that of the prediction, or about what made it old."""
    notes: tuple[str, ...] = ()
    """Sentences about how the reference was read."""


@dataclass(frozen=True)
class Reading:
    """How a file of markers or positions is read."""

    marker_map: Path | None = None
    """YAML file that maps markers to joints; None = markers have the joints' names."""
    first_frame: int | None = None
    """Match frame of the first row of positions; None = they have match frames."""


@dataclass(frozen=True, eq=False)
class Side:
    """Data of a prediction or a reference."""

    joints: JointTracks | None
    cameras: Mapping[str, Camera]
    """By static camera, or by broadcast view."""
    match: MatchFolder | None = None
    """The match it belongs to, if known."""
    age: str = ""
    """A sentence about a later run of the match, or about what made this one old."""
    fps: float | None = None
    """Frames per second; None if nothing states them."""


def score(
    prediction: str,
    reference: str,
    project: str,
    *,
    run_id: str = "latest",
    stage: str | None = None,
    fps: float | None = None,
    match_in: str | None = None,
    reading: Reading = Reading(),
) -> Scores:
    """Compute every score for which both prediction and reference have data.

    The prediction is a joints file, a folder with `joints.npz` and `cameras/`, or a match. Of a
    match's run, as for `open_results`, `stage` has the joints; None = the last one with any. The
    reference is such a file or folder, or a C3D or TRC file of markers, which is aligned with the
    prediction in time and space. It may be a CSV of positions, with which people are compared on
    the ground. `reading` says how its file is read; tracks are matched in the image of its camera
    `match_in`.

    `fps` None is what a side states. UsageError for an unknown name, or no data that both sides
    have.
    """
    suffix, notes = Path(reference).suffix.lower(), list[str]()
    measured, placed = suffix in SUFFIXES, suffix in TABLES
    truth = Side(None, {}) if measured or placed else reference_side(reference)
    estimate = _prediction(prediction, project, truth, run_id=run_id, stage=stage)
    match, known = estimate.match or truth.match, fps or estimate.fps or truth.fps
    require_one_rate({f"--prediction {prediction}": estimate.fps, reference: truth.fps})
    alignment = None
    if measured:
        tracks, alignment = _align_markers(
            Path(reference), estimate.joints, known, reading.marker_map, notes
        )
        truth = Side(tracks, {})
    elif placed and estimate.joints is not None:
        first = reading.first_frame
        mine, tracks, notes = align_positions(Path(reference), estimate.joints, first, known)
        estimate, truth = replace(estimate, joints=mine), Side(tracks, {})
    spec = None if match is None else match.spec
    if truth.joints is not None:  # views are of the reference's cameras, not the prediction's
        own = None if truth.match is None else truth.match.spec
        truth = replace(truth, joints=drop_views(truth.joints, own))
    true_cameras = cameras_of(reference, truth, spec)
    if match_in is not None and match_in not in true_cameras:
        raise UsageError(
            f"--match-in {match_in}",
            expected=f"a camera of the reference: {', '.join(true_cameras) or 'it has none'}",
            found=repr(match_in),
            todo="Name one of these, or omit the option.",
        )
    evaluation = Evaluation()
    people: tuple[PersonScore, ...] = ()
    if estimate.joints is not None and truth.joints is not None:
        evaluation, people = evaluate_joints(
            estimate.joints,
            truth.joints,
            fps=known,
            camera=None if match_in is None else true_cameras[match_in],
        )
    if placed:  # hips alone tell nothing of the challenge's joints
        names = ("challenge_score", "challenge_global_m", "challenge_local_m")
        evaluation = evaluation.model_copy(update=dict.fromkeys(names))
    errors, cameras = evaluate_cameras(estimate.cameras, true_cameras, _pitch(match))
    if not cameras and not people and evaluation.frames is None:
        raise UsageError(
            f"--prediction {prediction} --reference {reference}",
            expected="joints on both sides, or cameras of the same names",
            found=f"{_contents(estimate)} against {_contents(truth)}",
            todo="Name files or folders with the same kind of data.",
        )
    if cameras and match is None:
        notes.append("no match states the pitch: ground errors are those of one of 105 x 68 m")
    evaluation = evaluation.model_copy(update={"cameras": errors})
    return Scores(evaluation, people, cameras, alignment, estimate.age, tuple(notes))


def _align_markers(
    path: Path,
    prediction: JointTracks | None,
    fps: float | None,
    marker_map: Path | None,
    notes: list[str],
) -> tuple[JointTracks, ReferenceAlignment]:
    """Align a marker file with the prediction's frames and world; return its joints."""
    if prediction is None or fps is None:
        raise UsageError(
            f"--reference {path}",
            expected="predicted joints to align the markers with, and their frame rate",
            found="no joints" if prediction is None else "no frame rate",
            todo="Name a prediction with joints, and give --fps if it belongs to no match.",
        )
    markers = read_markers(path)
    if markers.zeros:
        notes.append(f"{markers.zeros} markers at exactly 0, 0, 0 count as missing")
    people = map_marker_names(markers.names) if marker_map is None else read_marker_map(marker_map)
    joints = marker_joints(markers, people)
    tracks, found = align_reference(prediction, joints, markers.rate, fps, markers.start)
    if not found.is_sure:
        notes.append(
            "the clock of the reference is not sure: with another offset within 2 s, joints are "
            f"{1000.0 * found.elsewhere:.0f} mm apart. Evaluate more frames in which people move, "
            "with clocks that differ by less than 2 s"
        )
    return tracks, found


def reference_side(name: str) -> Side:
    """Load the data of a ground truth file or folder, and the match next to it, or InputError."""
    path = Path(name)
    match = None
    if around := spec_around(path):  # without its videos, which may be gone
        match = MatchFolder(*around, {}, {}, read_pitch(*around), {}, {}, {}, {})
    folder = path if path.is_dir() else path.parent
    clip = path.name.removesuffix(".npz").removesuffix(".joints")
    rate = stated_rate(folder, clip)
    files = sorted((path / "cameras").glob("*.npz"))
    of_joints = path / "joints.npz" if path.is_dir() else path
    joints = read_joints(of_joints) if of_joints.is_file() or not files else None
    return Side(joints, {file.stem: read_camera(file) for file in files}, match, fps=rate)


def is_of_files(name: str) -> bool:
    """Return whether a prediction is a file or a folder of results, and not a match."""
    path = Path(name)
    return path.is_file() or (path / "joints.npz").is_file() or (path / "cameras").is_dir()


def _prediction(name: str, project: str, truth: Side, *, run_id: str, stage: str | None) -> Side:
    if is_of_files(name):
        return reference_side(name)
    store = Store.open(project)
    match = find_match(store, name, unfinished=True)
    run = open_results(store, match.match_id, run_id)
    age = describe_age(store, run.record) if run_id == LATEST else ""
    spec = match.folder.spec
    placed = any(unit.partition("/")[0] in JOINT_STAGES for unit in run)
    if not placed and truth.cameras and (cameras := static_cameras(run, spec)):
        return Side(None, cameras, match.folder, age, spec.fps)
    clips = clips_of(run.record)
    if len(clips) > 1:
        raise UsageError(
            f"--prediction {name}",
            expected="one clip",
            found=f"a match of {len(clips)} clips",
            todo="Export the match and score clip by clip.",
        )
    cameras = static_cameras(run, spec, stage) | broadcast_cameras(run) if truth.cameras else {}
    return Side(joint_tracks(run, clips[0], stage), cameras, match.folder, age, spec.fps)


def cameras_of(reference: str, truth: Side, spec: MatchSpec | None) -> dict[str, Camera]:
    """Return the true cameras with the image sizes of the match: the files lack them."""
    if spec is None:
        return dict(truth.cameras)
    known = {camera.id: camera for camera in spec.cameras}
    known |= {name: view.camera for name, view in spec.broadcast_views.items()}
    cameras = {}
    for name in truth.cameras:
        file = Path(reference) / "cameras" / f"{name}.npz"
        if name not in known:
            raise InputError(
                str(file),
                expected=f"a camera or clip of the match: {', '.join(known)}",
                found=repr(name),
                todo="Rename or remove the file.",
            )
        cameras[name] = read_camera(file, (known[name].width, known[name].height))
    return cameras


def _pitch(match: MatchFolder | None) -> PitchTemplate | None:
    """Return the match's pitch, or the standard one if no match is known."""
    if match is None:
        return PitchTemplate.standard()
    return None if match.pitch is None else PitchTemplate.from_spec(match.pitch)


def _contents(side: Side) -> str:
    cameras = f"cameras {', '.join(side.cameras)}" if side.cameras else "no cameras"
    return f"{'joints' if side.joints is not None else 'no joints'} and {cameras}"
