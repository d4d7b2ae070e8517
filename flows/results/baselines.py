"""Scores of baseline methods' results under the paper's protocol, and their table."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.evaluation import Evaluation, MethodScore
from flows.results.evaluation import cameras_of, reference_side
from worldpose.body.body_file import OPEN_BODY, find_body
from worldpose.errors import UsageError, unknown_name
from worldpose.evaluation.challenge import ALL
from worldpose.evaluation.matching import EvaluationSettings
from worldpose.evaluation.metrics import drop_views, evaluate_joints
from worldpose.formats.baselines import Method, find_method
from worldpose.formats.baselines.result import MethodResult, resample_result
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.release_cameras import RELEASE_SIZE
from worldpose.geometry.cameras import Camera


def score_methods(
    named: Sequence[str],
    reference: str,
    *,
    match_in: str | None = None,
    body: str | None = None,
    first_frame: int | None = None,
    fps: float | None = None,
    seen_fps: Mapping[str, float] | None = None,
) -> tuple[MethodScore, ...]:
    """Score results, NAME=PATH, of baseline methods; return each score with its settings.

    The reference is as for `worldpose evaluate`; tracks are matched in the image of its camera
    `match_in`. `body` is the model of poses, None = the open body. `first_frame` is the match frame
    of the methods' first image, None = the reference's. `fps` None is what the reference states;
    `seen_fps` has that of a method's input video, if not the clip's, to whose frames it is
    resampled.

    UsageError for an unknown method or camera, or a method that needs `match_in`.
    """
    settings = EvaluationSettings()
    truth = reference_side(reference)
    spec = None if truth.match is None else truth.match.spec
    cameras = cameras_of(reference, truth, spec)
    if truth.joints is None or (match_in is not None and match_in not in cameras):
        raise UsageError(
            f"--reference {reference}",
            expected="joints.npz" + (f" and cameras/{match_in}.npz" if match_in else ""),
            found=f"cameras {', '.join(cameras)}" if cameras else "no cameras",
            todo="Name the folder that contains these files.",
        )
    camera = None if match_in is None else cameras[match_in]
    true = drop_views(truth.joints, spec)
    frames = true.frames
    first = first_frame if first_frame is not None else int(frames[0]) if len(frames) else 0
    model = find_body(body or OPEN_BODY)
    rate = fps or truth.fps
    seen_fps = seen_fps or {}
    _require_scored(named, seen_fps)
    scores = []
    for item in named:
        method, path = _find_result(item)
        result = method.read(path, model, _image_size(camera))
        if method.name in seen_fps:
            result = resample_result(result, seen_fps[method.name], _clip_fps(rate, method.name))
        if result.world != "shared" and (camera is None or result.boxes is None):
            raise UsageError(
                f"--method {item}",
                expected="--match-in CAMERA, since its people have no common world frame",
                found=f"--match-in {match_in}",
                todo="Name the camera of the reference whose video the method used.",
            )
        joints = JointTracks(
            result.joints.frames + first, result.joints.person_ids, result.joints.joints
        )
        evaluation, _ = evaluate_joints(
            joints, true, settings, fps=rate, camera=camera, boxes=_boxes(result, camera)
        )
        scores.append(
            MethodScore(
                method=method.name,
                title=method.title,
                source=path.name,
                world=result.world,
                body_model=model.name,
                notes=dict(result.notes),
                match_in=match_in,
                first_frame=first,
                settings=settings.model_dump(mode="json"),
                evaluation=select_defined_scores(evaluation, result.world),
            )
        )
    return tuple(scores)


def _find_result(item: str) -> tuple[Method, Path]:
    """Return the method and the file or folder of NAME=PATH; raise UsageError if it is absent."""
    name, equals, path = item.partition("=")
    method = find_method(name)
    if not equals or not Path(path).exists():
        raise UsageError(
            f"--method {item}",
            expected=f"{name}=PATH of its result",
            found=f"{path or 'no path'}, which does not exist",
            todo="Name the file or folder of the method's result.",
        )
    return method, Path(path)


def _require_scored(named: Sequence[str], seen_fps: Mapping[str, float]) -> None:
    """Refuse a frame rate for a method that is not scored."""
    names = [item.partition("=")[0] for item in named]
    for name in seen_fps:
        if name not in names:
            raise unknown_name(f"--method-fps {name}", name, names, "Use the name from --method.")


def _clip_fps(fps: float | None, name: str) -> float:
    if fps is None:
        raise UsageError(
            f"--method-fps {name}",
            expected="--fps, the frames per second of the clip",
            found="neither --fps nor a match that states it",
            todo="Add --fps.",
        )
    return fps


def _image_size(camera: Camera | None) -> tuple[int, int]:
    """Return width and height of the video [px]."""
    if camera is None:
        return RELEASE_SIZE
    width, height = (int(side) for side in camera.image_size.reshape(-1, 2)[0])
    return width, height


def _boxes(result: MethodResult, camera: Camera | None) -> Floats | None:
    """Return the method's boxes in the camera's image [px]."""
    if result.boxes is None or camera is None or result.image_size is None:
        return result.boxes
    width, height = np.array(_image_size(camera)) / np.array(result.image_size)
    return np.asarray(result.boxes * np.array([width, height, width, height]))


COLUMNS: Final = {
    "g_mpjpe_mm": "G-MPJPE [mm]",
    "pa_mpjpe_mm": "PA-MPJPE [mm]",
    "per_meter_drift_cm_per_m": "Per-Meter Drift [cm/m]",
    "track_coverage": "Coverage [%]",
}
"""Metrics of a row, and their titles. The first three are the paper's."""
PER_PERSON: Final = {
    "g_mpjpe_mm": "per_person_g_mpjpe_mm",
    "per_meter_drift_cm_per_m": "per_person_drift_cm_per_m",
}
"""Metrics of a row with one alignment per person."""

_LOCAL: Final = ("pa_mpjpe_mm", "pa_mpjpe_rigid_mm", "track_coverage", "persons", "frames")
_ALONE: Final = (
    *_LOCAL,
    "per_person_g_mpjpe_mm",
    "per_person_g_mpjpe_rigid_mm",
    "per_person_drift_cm_per_m",
    "per_person_drift_rigid_cm_per_m",
)
_KEPT: Final = {"camera": _LOCAL, "own": _ALONE}


def select_defined_scores(evaluation: Evaluation, world: str) -> Evaluation:
    """Return the scores that are defined in a method's world.

    People relative to a moving camera (`camera`) have no paths, people in separate worlds (`own`)
    have no common alignment; `shared` keeps all.
    """
    if world not in _KEPT:
        return evaluation
    return Evaluation(**{name: getattr(evaluation, name) for name in _KEPT[world]})


def table_rows(scores: Sequence[MethodScore]) -> list[tuple[str, ...]]:
    """Return the table: a title and the metrics, `N/A` where undefined.

    First local methods, then all others, then these with one alignment per person, as in the paper.
    Scores by clip give such a table for each clip, then for all; each row begins with the clip.
    """
    return [row for group in _groups(scores) for row in group]


def table_columns(scores: Sequence[MethodScore]) -> tuple[str, ...]:
    """Return the titles of the columns before those of the metrics."""
    return ("clip", "method") if any(score.clips for score in scores) else ("method",)


def table_csv(scores: Sequence[MethodScore]) -> str:
    """Return the table as CSV with a header, with empty cells for undefined metrics."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow((*table_columns(scores), *COLUMNS))
    for row in table_rows(scores):
        writer.writerow("" if cell == _ABSENT else cell for cell in row)
    return out.getvalue()


def table_latex(scores: Sequence[MethodScore]) -> str:
    """Return the table as LaTeX for the package booktabs."""
    arrows = ("$\\downarrow$", "$\\downarrow$", "$\\downarrow$", "$\\uparrow$")
    heads = [f"{title} {arrow}" for title, arrow in zip(COLUMNS.values(), arrows, strict=True)]
    texts = len(table_columns(scores))
    lines = [f"\\begin{{tabular}}{{{'l' * texts}{'c' * len(heads)}}}", "  \\toprule"]
    lines.append("  " + texts * "& " + " & ".join(heads).replace("%", "\\%") + " \\\\")
    for group in _groups(scores):
        lines.append("  \\midrule")
        for row in group:
            cells = [re.sub(r"([&%_#$])", r"\\\1", text) for text in row[:texts]]
            for cell in row[texts:]:  # with thin spaces between thousands
                number = cell if cell == _ABSENT else f"{float(cell):,.1f}"
                cells.append(number.replace(",", "\\,"))
            lines.append(f"  {' & '.join(cells)} \\\\")
    return "\n".join([*lines, "  \\bottomrule", "\\end{tabular}"]) + "\n"


_ABSENT: Final = "N/A"


def _groups(scores: Sequence[MethodScore]) -> list[list[tuple[str, ...]]]:
    found = []
    for clip in {clip: None for score in scores for clip in score.clips}:
        own = [score.model_copy(update={"evaluation": score.clips[clip]}) for score in scores]
        found += [[(clip, *row) for row in group] for group in _method_groups(own)]
    lead = (ALL,) if found else ()
    return found + [[(*lead, *row) for row in group] for group in _method_groups(scores)]


def _method_groups(scores: Sequence[MethodScore]) -> list[list[tuple[str, ...]]]:
    local = [_row(score.title, score, {}) for score in scores if score.world == "camera"]
    placed = [score for score in scores if score.world != "camera"]
    whole = [_row(score.title, score, {}) for score in placed]
    alone = [_row(f"{score.title} (per-person)", score, PER_PERSON) for score in placed]
    return [group for group in (local, whole, alone) if group]


def _row(title: str, score: MethodScore, instead: dict[str, str]) -> tuple[str, ...]:
    cells = []
    for name in COLUMNS:
        value = getattr(score.evaluation, instead.get(name, name))
        factor = 100.0 if name == "track_coverage" else 1.0
        cells.append(_ABSENT if value is None else f"{factor * value:.1f}")
    return (title, *cells)
