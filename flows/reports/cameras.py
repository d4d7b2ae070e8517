"""Report section about the static cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from data_contracts.match import MatchSpec
from data_contracts.triangulation import HEALTH_MEASURES, CameraChange
from flows.layers import pitch_of_run
from flows.reports.match_pictures import background_image, shown_pitch
from flows.results.best_results import clip_title
from flows.review.metric_words import point_words
from flows.stage import Match
from worldpose.camera_consistency.health import judge_health
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.reports.html_page import CaptionedImage, Failure, Table
from worldpose.reports.run_report import format_scaled
from worldpose.reports.static_cameras import (
    NEAR_PAINT_PX,
    Click,
    ErrorMap,
    plot_calibration,
    plot_health,
    plot_paint,
)
from worldpose.static_calibration.from_paint.proposal import PROPOSED
from worldpose.store.store import Run, Store
from worldpose.triangulation.camera_changes import describe_change

MAX_CAMERAS = 2
"""Number of cameras shown with their clicks, weakest first."""

_ORIGINS = {
    "given": "given",
    "points": "clicks",
    "lines": "clicks and painted lines",
    "none": "left out",
}


def camera_table(run: Run, spec: MatchSpec) -> Table:
    """Tabulate origin, expected errors and clicks of each static camera."""
    columns = (
        *("camera", "from", ">expected ground error mm", ">95 % mm", ">clicks rms px", ">clicks"),
        *("wrong clicks", "weak because"),
    )
    rows = []
    for camera in spec.static_cameras:
        unit = f"static_calibration/{camera.id}"
        figures, origin, wrong = run.record.figures.get(unit, {}), _ORIGINS["none"], list[str]()
        if unit in run:
            result = run[unit]
            origin = _ORIGINS[result.attrs["origin"]]
            if str((result.attrs["decisions"] or [""])[0]).startswith(PROPOSED):
                origin = origin.replace("clicks", "proposed markings")
            if "point_inlier" in result:
                is_wrong = ~result["point_inlier"].values
                wrong = [point_words(str(name)) for name in result["point"].values[is_wrong]]
        rows.append(
            (
                camera.id,
                origin,
                format_scaled(figures.get("expected_ground_error_median_m"), 1000.0, 1),
                format_scaled(figures.get("expected_ground_error_p95_m"), 1000.0, 1),
                format_scaled(figures.get("reprojection_rms_px"), 1.0, 2),
                format_scaled(figures.get("clicks_used"), 1.0, 0),
                ", ".join(wrong),
                Failure("; ".join(_reasons(run, camera.id))),
            )
        )
    return Table("", columns, tuple(rows))


def _reasons(run: Run, camera_id: str) -> tuple[str, ...]:
    """Return why a person should check a camera: it was left out, failed, or is weak."""
    left_out, unit = run.record.left_out.get(camera_id), f"static_calibration/{camera_id}"
    if left_out is not None:
        return (f"left out: {left_out}",)
    if unit not in run:
        failed = (each.message for each in run.record.failed if each.unit == unit)
        return (next(failed, "not calibrated"),)
    return tuple(run[unit].attrs.get("reasons") or ())


def health_picture(run: Run, match: Match, clip: str) -> list[CaptionedImage]:
    """Draw the health of a clip's static cameras over time; none without triangulated people."""
    units = (f"{stage}/{clip}" for stage in ("retriangulation", "triangulation"))
    found = next((run[unit] for unit in units if unit in run), None)
    if found is None or "health" not in found:
        return []
    changes = [CameraChange.model_validate(each) for each in found.attrs["changes"]]
    used = found["camera"].values.tolist()
    names = list(dict.fromkeys([*(c.id for c in match.folder.spec.static_cameras), *used]))
    place = [names.index(name) for name in used]
    starts = found["health_frame"].values
    shape = (len(starts), len(names))
    badness, missing = np.full(shape, np.nan), np.full(shape, np.nan)
    values = found["health"].values.astype(np.float64)
    badness[:, place] = judge_health(values)
    missing[:, place] = values[..., HEALTH_MEASURES.index("missing")]
    marks = [
        *((change.camera, change.frame, _mark(change)) for change in changes),
        *((name, None, "left out") for name in names if name not in used),
    ]
    frames = np.append(starts, found["frame"].values[-1] + 1)
    said = "".join(f" {describe_change(change)}." for change in changes)
    return [
        CaptionedImage(
            f"{clip_title(clip)}: the health of each static camera over time, by the distance of "
            "its keypoints from the people that all cameras place, and by its images. Grey: no "
            f"person is seen to compare; black: frames without an image; blue: a change.{said}",
            plot_health(names, frames, badness, missing, marks),
        )
    ]


def _mark(change: CameraChange) -> str:
    """Return two or three words on a change."""
    if not change.is_explained:
        return "left out" if change.is_left_out else "unexplained"
    if change.kind == "clock":
        return f"{-change.late_frames:+.1f} frames" + ("" if change.frame is not None else " drift")
    return f"{'moves' if change.frame is None else 'knock'} {np.hypot(*change.shift_px):.0f} px"


def camera_pictures(
    store: Store, run: Run, match: Match, cameras: Mapping[str, Camera]
) -> list[CaptionedImage]:
    """Draw the weakest calibrated cameras: their clicks, and the expected error over the pitch."""
    errors = {
        name: run.record.figures.get(f"static_calibration/{name}", {}).get(
            "expected_ground_error_median_m", 0.0
        )
        for name in cameras
    }
    weakest = sorted((name for name in cameras if errors[name]), key=lambda name: -errors[name])
    shown = weakest[:MAX_CAMERAS] if shown_pitch(run, match) is not None else ()
    return [
        CaptionedImage(
            f"One of the least certain cameras, {name}: the pitch as it projects it, clicks "
            "as circles, clicks that it does not use as crosses; below, its expected "
            f"error on the ground, median {errors[name]:.2g} m.",
            camera_evidence(store, run, match, name, cameras[name]),
        )
        for name in shown
    ]


def paint_pictures(
    store: Store, run: Run, match: Match, cameras: Mapping[str, Camera]
) -> list[CaptionedImage]:
    """Draw painted lines in the image of the camera with most clicks, and the distance map."""
    pitch = shown_pitch(run, match)
    if pitch is None:
        return []
    counts = {
        name: run.record.figures.get(f"static_calibration/{name}", {}).get("clicks_used", 0.0)
        for name in cameras
        if name in match.folder.stills or name in match.folder.videos
    }
    if not counts:
        return []
    name = max(counts, key=lambda each: counts[each])
    still = background_image(store, match, name)
    if still is None:  # no image of the video's clips can be read
        return []
    png, share = plot_paint(cameras[name], still, pitch)
    return [
        CaptionedImage(
            f"Camera {name}: paint in its image, and the distance of every pixel from it, with the "
            "markings as the estimated camera projects them. Where any paint is within "
            f"{NEAR_PAINT_PX:.0f} px, {share:.0%} of them lie on it. This is a separate check: "
            "cameras are not estimated in this way.",
            png,
        )
    ]


def camera_evidence(store: Store, run: Run, match: Match, name: str, camera: Camera) -> bytes:
    """Return a PNG of one calibrated camera: clicks on its still, and the expected ground error."""
    pitch = shown_pitch(run, match)
    assert pitch is not None, "nothing is clicked without a pitch"
    result = run[f"static_calibration/{name}"]
    names = (str(point) for point in result["point"].values)
    inlier = dict(zip(names, result["point_inlier"].values.tolist(), strict=True))
    # The clicks that the run used: those of the folder may have changed since.
    recipe = run.manifest(f"static_calibration/{name}").recipe
    files = cast("dict[str, Any]", recipe.sources["clicked"]).values()
    clicked = {point: np.array(at) for file in files for point, at in file["points"].items()}
    return plot_calibration(
        camera,
        f"camera {name}",
        pitch,
        clicks=[Click(point_words(point), at, inlier[point]) for point, at in clicked.items()],
        still=background_image(store, match, name),
        error_map=ErrorMap(
            result["ground_x"].values, result["ground_y"].values, result["ground_error"].values
        ),
    )


def proposal_evidence(
    store: Store, run: Run, match: Match, name: str
) -> tuple[CaptionedImage, Table] | None:
    """Draw the camera that was proposed for an image, and list the markings that it expects.

    None if no camera was proposed.
    """
    pitch = pitch_of_run(run, lambda: match.folder.pitch)
    if pitch is None or f"proposal/{name}" not in run.record.results:
        return None
    found = run[f"proposal/{name}"]
    if found.attrs["origin"] != "image":
        return None
    png = plot_calibration(
        camera_from_arrays(found.data_vars),
        f"camera {name}, as proposed",
        pitch,
        still=background_image(store, match, name),
    )
    caption = (
        "The pitch as the proposed camera projects it. If its lines lie on the painted ones, "
        "accept the proposal on the page of its clicks; else click the markings."
    )
    rows = tuple(
        (marking.replace("_", " "), f"{visible:.0f}", f"{share:.0%}")
        for marking, visible, share in found.attrs["markings"]
    )
    columns = ("marking", ">length in the image [px]", ">on paint")
    return CaptionedImage(caption, png), Table("Markings that the proposal expects", columns, rows)
