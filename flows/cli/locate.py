"""Command locate-cameras: find the poses of static cameras from the people who walk past them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer

from data_contracts.cameras import CameraCalibration, LensCalibration
from flows.cli import console
from flows.cli.console import DEFAULT_PROJECT, JsonOption, MatchArgument, ProjectOption
from flows.cli.options import WorkersOption
from flows.cli.synchronize import compute_poses
from flows.registering import find_match
from flows.results.clock_offsets import choose_clip, load_detections
from flows.results.outputs import require_new
from flows.running import RunRequest
from flows.stage import Match
from worldpose.errors import InputError, UsageError
from worldpose.formats.lens_files import square_focal
from worldpose.store.store import Store

if TYPE_CHECKING:
    from worldpose.bundle_adjustment.people_cameras import CamerasFromPeople, KnownLength

UNKNOWN_FOCAL: Final = 0.3
"""Relative deviation of a focal length that nothing is known of [1]."""
UNKNOWN_CENTER: Final = 0.02
"""Deviation of such a lens's principal point from the middle, in image widths [1]."""
GIVEN_FOCAL: Final = 0.002
"""Relative deviation of the focal length in calibration.toml [1]."""
GIVEN_CENTER_PX: Final = 2.0
"""Deviation of the principal point there [px]."""
STATURE_STD_M: Final = 0.01
"""Standard deviation of a measured stature or distance [m]."""


def locate_cameras(
    match: MatchArgument,
    stature: Annotated[float | None, typer.Option(min=0.5, max=2.5)] = None,
    distance: Annotated[
        tuple[str, str, float] | None, typer.Option(metavar="CAMERA CAMERA METRES")
    ] = None,
    clip: str | None = None,
    out: Path | None = None,
    apply: Annotated[bool, typer.Option("--apply")] = False,
    workers: WorkersOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Find the poses of static cameras from people who walk through their views, without a pitch.

    Lenses come from lenses.toml (worldpose calibrate), or from calibration.toml; unknown focal
    lengths are estimated too, if all cameras have about the same. The videos must be synchronous.
    The scale comes from --stature or --distance, the vertical from feet and bodies.

    Example: worldpose locate-cameras matches/lab --stature 1.78 --apply

    Options:
        stature: Stature of the people, median if several [m].
        distance: Measured distance of two cameras [m].
        clip: Clip whose people are used; the longest by default.
        out: Calibration (TOML) to write.
        apply: Write calibration.toml into the match folder.
    """
    from worldpose.bundle_adjustment.people_cameras import KnownLength
    from worldpose.bundle_adjustment.people_cameras import locate_cameras as estimate

    if (stature is None) == (distance is None):
        raise UsageError(
            "--stature",
            expected="either --stature or --distance, which gives the scale",
            found="neither" if stature is None else "both",
            todo="Measure the person who walks, or the distance of two cameras.",
        )
    require_new(out)
    store = Store.open_or_new(project)
    with console.progress(verbose=False):
        opened = find_match(store, match, unfinished=True)
        folder = opened.folder
        if folder.pitch is not None:
            raise InputError(
                f"{opened.match_id}: pitch",
                expected="a match without a pitch",
                found="a pitch, whose markings locate cameras better",
                todo="Click the markings, or write `pitch: none` into match.yaml.",
            )
        if apply and (folder.folder / "calibration.toml").exists():
            raise InputError(
                str(folder.folder / "calibration.toml"),
                expected="no calibration there yet",
                found="one",
                todo="Move the file away first, or give --out.",
            )
        lenses = [_lens(opened, camera.id) for camera in folder.spec.static_cameras]
        names = [lens.id for lens in lenses]
        known = KnownLength(stature or 0.0, None, STATURE_STD_M)
        if distance is not None:
            known = _distance(distance, names)
        chosen = choose_clip(folder.spec, clip)
        # Cameras without a calibration are left out once it is computed: it is passed over.
        ingest, poses = RunRequest({}, "ingest", "ingest"), RunRequest({}, "detection", "detection")
        run = compute_poses(store, opened, workers, ingest, poses)
    detections = load_detections(run, opened, chosen, names)
    found = estimate(lenses, detections, folder.spec.fps, known)
    calibrations = {name: found.cameras[c].to_calibration(name) for c, name in enumerate(names)}
    written = _write(calibrations, folder.folder if apply else None, out)
    if as_json:
        console.print_json({"clip": chosen, "written": written, **_as_json(found, names)})
        return
    _print(found, names, written, known)


def _lens(match: Match, camera: str) -> LensCalibration:
    """Return what is known of a camera's lens."""
    folder = match.folder
    if camera in folder.lenses:
        return folder.lenses[camera]
    if camera in folder.calibrations:
        given = folder.calibrations[camera]
        focal, differ = square_focal(
            given.focal_px, f"{folder.folder / 'calibration.toml'}: {camera}"
        )
        return LensCalibration(
            id=camera,
            image_size=given.image_size,
            focal_px=focal,
            principal_point_px=given.principal_point_px,
            distortion=given.distortion,
            lens_model=given.lens_model,
            focal_std_px=max(GIVEN_FOCAL * focal, differ),
            principal_point_std_px=GIVEN_CENTER_PX,
            distortion_std=0.005,
        )
    spec = folder.spec.camera(camera)
    width, height = spec.width, spec.height
    return LensCalibration(
        id=camera,
        image_size=(width, height),
        focal_px=float(max(width, height)),
        principal_point_px=(0.5 * (width - 1), 0.5 * (height - 1)),
        focal_std_px=UNKNOWN_FOCAL * max(width, height),
        principal_point_std_px=UNKNOWN_CENTER * width,
        distortion_std=0.05,
    )


def _distance(given: tuple[str, str, float], names: list[str]) -> KnownLength:
    """Return the measured distance of two cameras."""
    from worldpose.bundle_adjustment.people_cameras import KnownLength

    one, other, metres = given
    if one not in names or other not in names or one == other or not metres > 0.0:
        raise UsageError(
            f"--distance {one} {other} {metres:g}",
            expected=f"two of the cameras {', '.join(names)}, and their distance in metres",
            found="others",
            todo="Correct it.",
        )
    return KnownLength(metres, (names.index(one), names.index(other)), STATURE_STD_M)


def _write(
    calibrations: dict[str, CameraCalibration], folder: Path | None, out: Path | None
) -> list[str]:
    """Write the calibration to a file, and into a match folder in place of its lenses."""
    from worldpose.formats.calibration_writer import write_calibration_toml
    from worldpose.formats.files import whole_file
    from worldpose.ingest.match_folder import LENS_FILE

    places = [] if out is None else [out]
    if folder is not None:
        places.append(folder / "calibration.toml")
    for place in places:
        with whole_file(place) as draft:
            write_calibration_toml(draft, calibrations)
    if folder is not None and (folder / LENS_FILE).exists():
        # A lens that is known with its pose stands in calibration.toml alone.
        (folder / LENS_FILE).rename(folder / f"{LENS_FILE}.before")
        places.append(folder / f"{LENS_FILE}.before")
    return [str(place) for place in places]


def _as_json(found: CamerasFromPeople, names: list[str]) -> dict[str, Any]:
    """Return the report of the command."""
    return {
        "people": found.people,
        "stature_m": found.stature_m,
        "scale_std": found.scale_std,
        "up_std_rad": found.up_std,
        "vertical_by": "feet" if found.on_feet else "bodies",
        "noise": asdict(found.noise),
        "cameras": {
            name: {
                "position_m": found.cameras.center[c].tolist(),
                "position_std_m": float(found.std[c, 0]),
                "rotation_std_rad": float(found.std[c, 1]),
                "focal_px": float(found.cameras.focal[c, 0]),
                "focal_std": float(found.std[c, 2]),
                "keypoints": int(found.keypoints[c]),
                "residual_px": float(found.residual_px[c]),
                "held_out_px": None
                if np.isnan(found.held_out_px[c])
                else float(found.held_out_px[c]),
                "coverage": float(found.coverage[c]),
            }
            for c, name in enumerate(names)
        },
    }


def _print(
    found: CamerasFromPeople, names: list[str], written: list[str], known: KnownLength
) -> None:
    """Print a table of the cameras with their standard deviations."""
    rows = []
    for c, name in enumerate(names):
        x, y, z = found.cameras.center[c]
        held = found.held_out_px[c]
        rows.append(
            (
                name,
                f"{x:.2f}, {y:.2f}, {z:.2f} +- {found.std[c, 0]:.2f}",
                f"{np.degrees(found.std[c, 1]):.2f}",
                f"{found.cameras.focal[c, 0]:.0f} +- {100 * found.std[c, 2]:.1f} %",
                str(found.keypoints[c]),
                f"{found.residual_px[c]:.1f}",
                "-" if np.isnan(held) else f"{held:.1f}",
                f"{100 * found.coverage[c]:.0f}",
            )
        )
    head = (
        *("camera", ">position m", ">rotation +- deg", ">focal length px", ">keypoints"),
        *(">residual px", ">held out px", ">coverage %"),
    )
    console.print_table("cameras by the people", head, rows)
    by = "standing feet" if found.on_feet else "upright bodies"
    console.line(
        f"{found.people} people, stature {found.stature_m:.2f} m by their limbs; all lengths "
        f"+- {100 * found.scale_std:.1f} %; vertical by {by}, +- {np.degrees(found.up_std):.1f} deg"
    )
    if known.cameras is None and found.people > 1:
        console.line("The stature given is that of the median person.")
    for place in written:
        console.line(f"wrote {place}")
    if not written:
        console.line("Add --apply to write calibration.toml into the match folder, or --out FILE.")
