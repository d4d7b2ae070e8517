"""Commands locate-cameras and synchronize: poses and clocks of cameras, from people in them."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer

from data_contracts.cameras import CameraCalibration, LensCalibration
from data_contracts.match import ClockOffset
from flows.cli import console
from flows.cli.options import DEFAULT_PROJECT
from flows.registering import find_match
from flows.results.clock_offsets import ClockOffsets, choose_clip, find_offsets, load_detections
from flows.results.outputs import claim_file, require_new
from flows.run_record import alone_with
from flows.running import RunRequest, run_match
from flows.stage import Match
from worldpose.bundle_adjustment.people_cameras import CamerasFromPeople, KnownLength
from worldpose.bundle_adjustment.people_cameras import locate_cameras as estimate
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_unit import square_focal
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.files import whole_file
from worldpose.ingest.match_folder import LENS_FILE
from worldpose.store.store import Run, Store

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
    match: str,
    stature: Annotated[float | None, typer.Option(min=0.5, max=2.5)] = None,
    distance: Annotated[
        tuple[str, str, float] | None, typer.Option(metavar="CAMERA CAMERA METRES")
    ] = None,
    clip: str | None = None,
    out: Path | None = None,
    apply: bool = False,
    workers: int | None = None,
    project: str = DEFAULT_PROJECT,
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
    console.print_json({"clip": chosen, "written": written, **_as_json(found, names)})
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
            f"{name}\t{x:.2f}, {y:.2f}, {z:.2f} +- {found.std[c, 0]:.2f}\t"
            f"{np.degrees(found.std[c, 1]):.2f}\t"
            f"{found.cameras.focal[c, 0]:.0f} +- {100 * found.std[c, 2]:.1f} %\t"
            f"{found.keypoints[c]}\t{found.residual_px[c]:.1f}\t"
            f"{'-' if np.isnan(held) else f'{held:.1f}'}\t{100 * found.coverage[c]:.0f}"
        )
    head = "camera\t>position m\t>rotation +- deg\t>focal length px\t>keypoints\t"
    head += ">residual px\t>held out px\t>coverage %"
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


def synchronize(
    match: str,
    clip: str | None = None,
    max_offset: Annotated[float, typer.Option(min=0.1, max=60.0)] = 2.0,
    plot: Path | None = None,
    apply: bool = False,
    workers: int | None = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Find the clock offsets of the static cameras from moving people, and propose offset_frames.

    The cameras must be calibrated, and nothing must be known of their clocks. The command computes
    the match up to the 2D poses first. The offset of the first camera whose clock does not change
    stays, and --apply writes the others. A clock that drifts or steps has pairs [match frame,
    offset].

    Example: worldpose synchronize matches/lab --plot clocks.svg --apply

    Options:
        clip: Clip whose people are compared; the longest by default.
        max_offset: Largest offset between two cameras [s].
        plot: Plot of the matches by offset to write: .svg, .pdf or .png.
        apply: Write the proposed offset_frames into match.yaml.
    """
    from worldpose.reports.drawing import draw_synchronization, require_plot

    if plot is not None:
        require_plot(plot)
    store = Store.open_or_new(project)
    with console.progress(verbose=False):
        opened = find_match(store, match)
        spec = opened.folder.spec
        chosen_clip = choose_clip(spec, clip)
        claim_file(plot, opened.match_id)
        run = compute_poses(store, opened, workers, RunRequest({}, until_stage="detection"))
    offsets = find_offsets(run, opened, chosen_clip, max_offset)
    found, rows, changed = offsets.found, offsets.rows, offsets.changed
    if plot is not None:
        draw_synchronization(found, offsets.names, plot)
    if apply and changed:
        from worldpose.ingest.writing import write_offsets

        write_offsets(opened.folder.folder, changed)
    console.print_json(
        {
            "clip": chosen_clip,
            "cameras": [row._asdict() for row in rows],
            "applied": changed if apply else {},
        }
    )
    _print_offsets(offsets, plot, applied=apply)
    if offsets.warning:
        console.line(f"warning: {offsets.warning}", to=console.errors)
    is_known = np.isfinite(found.late).all() and not offsets.warning
    raise typer.Exit(0 if is_known else 4)


def compute_poses(store: Store, match: Match, workers: int | None, *parts: RunRequest) -> Run:
    """Compute parts of the method, up to the 2D poses, with the gates of the match's other runs."""
    with alone_with(store, match.match_id):
        for part in parts:
            record = run_match(store, match, replace(part, workers=workers))
    if record.waiting and any(name.startswith("detection/") for name in record.blocked):
        raise InputError(
            f"{match.match_id}: 2D poses",
            expected="all results that they need",
            found=f"{len(record.waiting)} that wait for review",
            todo=f"Decide them first: worldpose review list {match.match_id}.",
        )
    return Run(store, record)


def _offset_text(offset: ClockOffset) -> str:
    """Return an offset as in match.yaml."""
    pairs = [list(pair) for pair in offset] if isinstance(offset, tuple) else offset
    return str(pairs)


def _print_offsets(offsets: ClockOffsets, plot: Path | None, *, applied: bool) -> None:
    """Print a table of the offsets, and what to do with them."""
    changed = offsets.changed
    shown = []
    for row in offsets.rows:
        about = row.reason if row.relative_to is None else f"relative to {row.relative_to}"
        by_people = row.found, row.std
        if row.camera == row.relative_to:
            about, by_people = "the reference: its offset stays", (None, None)
        texts = [
            "-" if each is None else f"{round(each, 2) + 0.0:.2f}" for each in by_people
        ]  # no -0
        proposed = "-" if row.found is None else _offset_text(row.proposed)
        shown.append((row.camera, _offset_text(row.stated), *texts, proposed, about))
    head = ("camera", ">offset_frames", ">by the people", ">standard deviation", ">proposed", "")
    console.print_table("clock offsets, in frames of each camera", head, shown)
    if plot is not None:
        console.line(f"wrote {plot}")
    console.line(offsets.verdict)
    if applied and changed:
        console.line(f"wrote offset_frames of {', '.join(changed)} into match.yaml")
    elif changed:
        console.line("Add --apply to write the proposed offsets into match.yaml.")
    if offsets.has_rest:
        console.line(
            "The fraction of a frame remains; worldpose run --set "
            "triangulation.correct_clocks=true corrects it."
        )
