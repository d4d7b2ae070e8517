"""Commands that create and register matches: import, ingest."""

from __future__ import annotations

from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Annotated, Final

import typer

from data_contracts.cameras import COEFFICIENTS
from data_contracts.match import MatchSpec
from data_contracts.pitch import TemplateName
from flows.cli.console import answer, errors, line, print_json, print_table
from flows.cli.options import DEFAULT_PROJECT, given_options
from flows.layers import known_pitch
from flows.registering import register, runs_of_pitch
from flows.stage import Match
from worldpose.errors import UsageError, WorldposeError
from worldpose.formats.calibration_unit import doubt_middle
from worldpose.ingest.camera_data import import_camera_data
from worldpose.ingest.clicks import import_clicks
from worldpose.ingest.footage import uncovered_clips
from worldpose.ingest.importing import import_lenses, import_match, import_videos
from worldpose.ingest.match_folder import read_spec, unclicked_clips
from worldpose.ingest.pitch_file import require_free_pitch
from worldpose.ingest.pose2sim import import_pose2sim
from worldpose.ingest.writing import import_boxes
from worldpose.store.store import Store


def import_command(
    out: Path,
    calibration: Path | None = None,
    detections: Path | None = None,
    videos: Path | None = None,
    boxes: Path | None = None,
    join: bool = False,
    pose2sim: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    challenge: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    fps: float | None = None,
    match_id: str | None = None,
    pitch: Path | None = None,
    clicks: Path | None = None,
    camera: str | None = None,
    lens: list[Path] | None = None,
    camera_data: Path | None = None,
    first_frame: Annotated[int | None, typer.Option(min=0)] = None,
    freed_camera: Annotated[int | None, typer.Option(min=0, max=255)] = None,
    zoom_table: Path | None = None,
    left_handed: bool = False,
    template: TemplateName | None = None,
    unit: str | None = None,
    up: str | None = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Import calibration and 2D poses or videos, boxes, clicks, lenses or a pitch into a folder.

    Example: worldpose import --calibration cal.toml --detections poses --fps 25 --out matches/lab

    Options:
        out: Match folder to create or to extend.
        calibration: Cameras: a file of Anipose, Pose2Sim, caliscope, FreeMoCap, Qualisys,
            Vicon, OptiTrack, OpenCap, EasyMocap, bioCV, Panoptic Studio, multical, Kalibr or
            OpenPose, or the folder of one file per camera.
        detections: Folder of COCO, AlphaPose, MMPose or Ultralytics results, <camera>.json,
            or of a folder of JSON for each frame (OpenPose and the others) for each camera.
        videos: Folder of videos in place of 2D poses, <camera>.mp4, or of a folder of
            images for each camera.
        boxes: With --videos, or for the videos of a match folder: people's boxes, in which only
            poses are estimated: folder of MOTChallenge lines, <camera>.txt.
        join: With --videos: join the chapters of one recording (GX010001, GX020001).
        pose2sim: Trial of Pose2Sim: Config.toml, calibration/, pose/ with OpenPose JSON,
            videos/.
        challenge: Folder of a pose challenge: cameras/, boxes/, videos/ or images/, skel_2d/,
            skel_3d/ and pitch_points.txt; writes OUT/<sequence> for each sequence.
        match_id: Id of the match; the folder's name by default.
        pitch: Survey of the markings (CSV); writes only pitch.json.
        clicks: Clicks from CVAT (XML), Label Studio, labelme, COCO or SoccerNet (JSON). A label is
            the name of a point or marking of the pitch, or a position in metres.
        camera: With --clicks, --lens or --camera-data: the camera, or the clip of the broadcast
            camera; by default, images and lenses are named after cameras.
        lens: Lens without a pose: OpenCV XML or YAML, ROS or Kalibr YAML, npz, OpenCap's
            pickle, matrix and distortion as two .npy files, or TOML.
        camera_data: Data of the broadcast camera in every frame: FreeD packets, also in a pcap, or
            a table with pan, tilt, roll [deg], x, y, z, and focal_px, fov, or focal_mm.
        first_frame: With --camera-data: number in the video of its first frame.
        freed_camera: With --camera-data: FreeD's number of the camera.
        zoom_table: With --camera-data: focal lengths of the lens by FreeD's zoom counts (CSV).
        left_handed: The survey's x, y and height are left-handed.
        template: With --pitch: the game whose markings are surveyed, such as futsal; football by
            default.
        unit: Unit of the calibration's positions: mm, cm, m, in, ft, yd, km, or its metres, such as
            0.08. By default people's stature tells it.
        up: Axis of the calibration's world that points up: x, -x, y, -y, z, -z, or three numbers.
            By default people who stand tell it.
    """
    given = set(given_options(import_command, locals())) - {"--project"}
    if videos is not None:  # then they are a part of the match
        given -= {"--boxes", "--join"}
    kind = next((name for name in ALONE if name in given), None)
    if kind is not None:
        _require_alone(kind, given)
    place = None
    if kind in (None, "--pose2sim"):
        from worldpose.triangulation.world import place_as_stated  # late: it loads the tracker

        place = place_as_stated(unit, up)
    if kind == "--boxes" and boxes is not None:
        changes: list[str] = []
        counts = import_boxes(boxes, out, changes)
        lines = (f"wrote {out / 'boxes' / name}.txt: {n} boxes" for name, n in counts.items())
        told = {"notes": changes} if changes else {}
        answer({"folder": str(out), "boxes": counts, **told}, *lines, *changes)
    elif kind == "--lens" and lens is not None:
        _import_lenses(lens, out, camera)
    elif kind == "--clicks" and clicks is not None:
        _import_clicks(clicks, out, camera, Store.open_or_new(project))
    elif kind == "--camera-data" and camera_data is not None:
        target, data = import_camera_data(
            camera_data, out, camera, first=first_frame, number=freed_camera, zoom_table=zoom_table
        )
        about = {"file": str(target), "rows": len(data.frame), "notes": list(data.notes)}
        answer(about, f"wrote {target}: {len(data.frame)} rows", *data.notes)
    elif kind == "--pitch" and pitch is not None:
        require_free_pitch(out, runs_of_pitch(Store.open_or_new(project), out))
        import_pitch(pitch, template, out, left_handed=left_handed)
    elif challenge is not None:
        _import_challenge(challenge, out, fps)
    elif pose2sim is not None:
        spec, notes = import_pose2sim(pose2sim, out, fps=fps, match_id=match_id, place=place)
        _print_match(spec, out, notes)
    elif videos is not None and detections is None:
        spec, notes = import_videos(
            calibration,
            videos,
            out,
            fps=fps,
            match_id=match_id,
            boxes=boxes,
            place=place,
            join=join,
        )
        _print_match(spec, out, notes)
    elif calibration is None or detections is None or videos is not None or fps is None:
        raise UsageError(
            "worldpose import",
            expected="--calibration with --detections and --fps or with --videos, or --pitch",
            found="some of them missing, or both",
            todo="Read the help: worldpose import --help.",
        )
    else:
        spec, notes = import_match(
            calibration, detections, fps, out, match_id=match_id, place=place
        )
        _print_match(spec, out, notes)


ALONE: Final = {
    "--boxes": ("with --videos, or with --out alone", ()),
    "--pose2sim": (
        "with --out, and --fps, --match-id, --unit or --up",
        ("--fps", "--match-id", "--unit", "--up"),
    ),
    "--challenge": ("with --out, and --fps for images", ("--fps",)),
    "--lens": ("with --out, and --camera if the file does not name its camera", ("--camera",)),
    "--clicks": ("with --out, and --camera if images are not named after cameras", ("--camera",)),
    "--camera-data": (
        "with --out, and --camera, --first-frame, --freed-camera or --zoom-table",
        ("--camera", "--first-frame", "--freed-camera", "--zoom-table"),
    ),
    "--camera": ("with --clicks, --lens or --camera-data", ()),
    **dict.fromkeys(
        ("--first-frame", "--freed-camera", "--zoom-table"), ("with --camera-data", ())
    ),
    "--pitch": ("with --out alone", ("--left-handed", "--template")),
    "--template": ("with --pitch", ()),
    "--left-handed": ("with --pitch", ()),
    "--join": ("with --videos", ()),
}
"""Options that decide what is imported, the first given one; and the others that each may have."""


def _require_alone(kind: str, given: set[str]) -> None:
    """Refuse options of another import."""
    with_what, allowed = ALONE[kind]
    others = sorted(given - {kind, *allowed})
    parts = ("with --pitch", "with --videos", ALONE["--camera"][0], ALONE["--zoom-table"][0])
    if others or with_what in parts:
        raise UsageError(
            kind,
            expected=f"{kind} {with_what}",
            found=", ".join(others) or f"{kind} alone",
            todo="Import the match first; the rest can be added to its folder then.",
        )


def _import_challenge(kit: Path, out: Path, fps: float | None) -> None:
    """Write a match for each sequence of a challenge, and print what was read."""
    from worldpose.body_fitting.skeletons import pose_skeletons  # late: it loads the body
    from worldpose.ingest.challenge_kit import import_challenge

    made = import_challenge(kit, out, pose_skeletons, fps)
    lines = [note for _, notes in made.values() for note in notes]
    folders = {name: str(out / name) for name in made}
    following = [f"next: worldpose run {folder}" for folder in folders.values()]
    answer({"folders": folders, "notes": lines}, *lines, *following)


def _print_match(spec: MatchSpec, out: Path, notes: list[str]) -> None:
    """Print a match that was made, and sentences about what was found."""
    about = {"notes": notes} if notes else {}
    print_json({"match": spec.match_id, "folder": str(out), **about})
    clip = spec.clips[0]
    for note in notes:
        line(note)
    for camera in spec.cameras:
        if camera.video is not None and (file := Path(camera.video)).stem != camera.id:
            line(f"{file.name} is camera {camera.id}")
    line(
        f"made match {spec.match_id} in {out}: {len(spec.cameras)} cameras, frames "
        f"{clip.first_frame} to {clip.first_frame + clip.frame_count - 1}"
    )
    is_calibrated = (out / "calibration.toml").exists()
    line(f"next: worldpose {'run' if is_calibrated else 'ingest'} {out}")


def _import_lenses(files: list[Path], out: Path, camera: str | None) -> None:
    """Write lenses without a pose into a match folder, and print them with their deviations."""
    lenses = import_lenses(files, out, camera)
    cameras = {name: lens.model_dump(mode="json") for name, lens in lenses.items()}
    print_json({"folder": str(out), "lenses": cameras})
    line(f"wrote {out / 'lenses.toml'}; the deviations can be edited there")
    for name, lens in lenses.items():
        x, y = lens.principal_point_px
        line(
            f"{name}: {lens.lens_model} lens ({', '.join(COEFFICIENTS[lens.lens_model])}), focal "
            f"length {lens.focal_px:.1f} px (standard deviation "
            f"{lens.focal_std_px:.1f}), principal point {x:.1f}, {y:.1f} "
            f"({lens.principal_point_std_px:.1f}), the image's corner "
            f"{100 * lens.distortion_std:.2g} % of its distance; its pose comes from clicks"
        )
        for warning in doubt_middle(name, lens.principal_point_px, lens.image_size):
            line(warning)


def _import_clicks(file: Path, out: Path, camera: str | None, store: Store) -> None:
    """Write clicks and own points into a match folder, and print what was read."""
    pitch = known_pitch(store, out, read_spec(out))
    found = import_clicks(file, out, camera, pitch, runs_of_pitch(store, out))
    questions = []
    if found.repeated:
        from flows.review.repeated_clicks import explain_repeated  # late: it loads the estimators

        questions = explain_repeated(out, file, found.repeated)
    print_json({"folder": str(out), **asdict(found), "questions": questions})
    for name in found.files:
        line(f"wrote {out / name}")
    for owner, count in found.clicks.items():
        line(f"{owner}: {count} clicks and lines")
    for note in found.notes:
        line(note)
    if found.mirrored is not None:
        side = "near" if found.mirrored else "far"
        line(f"places: y points to the {side} side, as the clicks show")
    if found.own_points:
        line(f"{len(found.own_points)} points that the rules do not name are in pitch.json")
    for text in questions:
        line(f"warning: {text}", to=errors)


def import_pitch(
    survey: Path, template: TemplateName | None, out: Path, *, left_handed: bool
) -> None:
    """Align a survey with the world frame, write pitch.json and print the residuals."""
    from worldpose.formats.files import whole_file
    from worldpose.pitch.survey import SurveySettings, fit_survey, read_survey

    file = out / "pitch.json"
    if file.exists():
        raise UsageError(
            str(file), expected="no pitch there yet", found="one", todo="Move the file away first."
        )
    fit = fit_survey(
        read_survey(survey, template or "football"), SurveySettings(left_handed=left_handed)
    )
    with whole_file(file) as draft:
        draft.write_text(fit.pitch.model_dump_json(indent=2) + "\n", encoding="utf-8")
    rows = sorted(
        zip(fit.names, fit.offset_plan.tolist(), fit.offset_height.tolist(), strict=True),
        key=lambda row: -row[1],
    )
    size = {name: getattr(fit.pitch, name) for name in ("length", "width", "crown")}
    heights = {name: None if isnan(height) else height for name, _, height in rows}
    print_json(
        {
            "pitch": str(file),
            **size,
            "measured": fit.measured,
            "scale": fit.scale,
            "slope": fit.slope,
            "offset_plan_m": {name: plan for name, plan, _ in rows},
            "offset_height_m": heights,
        }
    )
    line(f"wrote {file}")
    for name, value in size.items():
        line(f"{name}: {value:.3f} m{'' if name in fit.measured else ' (the survey cannot tell)'}")
    line(f"lengths of the survey over true ones: {fit.scale:.5f} (kept as they are)")
    line(f"levelled a slope of {100 * fit.slope[0]:.2f} % along x, {100 * fit.slope[1]:.2f} % in y")
    shown = [
        (name, f"{1e3 * plan:.0f}", "-" if isnan(height) else f"{1e3 * height:+.0f}")
        for name, plan, height in rows
    ]
    print_table("off the rules of the game", ("point", ">in plan mm", ">above surface mm"), shown)


def ingest(
    folders: Annotated[list[Path], typer.Argument(metavar="MATCH...")],
    project: str = DEFAULT_PROJECT,
) -> None:
    """Validate match folders and register them in the project; repeating it is harmless.

    Example: worldpose ingest matches/tiny

    Options:
        folders: Match folders.
    """
    store = Store.open_or_new(project)
    rows = []
    refused: list[str] = []
    for folder in folders:
        try:
            match, changed = register(store, folder, unfinished=True)
        except WorldposeError as failure:
            refused.append(str(failure))
            line(f"error: {failure}", to=errors)
            continue
        rows.append({"match": match.match_id, "folder": str(folder), "changed": changed})
        for text in uncovered_clips(match.folder) if changed else ():
            line(f"warning: {text}", to=errors)
        known = "registered" if changed else "already registered, unchanged:"
        line(f"{known} {match.match_id}")
        _tell_unclicked(match)
    print_json({"matches": rows, "refused": refused})
    if refused:
        raise typer.Exit(4 if rows else 1)


def _tell_unclicked(match: Match) -> None:
    """Print what has to be clicked before the match can run."""
    missing = [*match.folder.to_click, *unclicked_clips(match.folder)]
    if missing and match.folder.pitch is None:
        line(
            f"no calibration of {', '.join(missing)}: on a pitch, delete the line `pitch: none` of "
            "match.yaml, repeat this command, and click the markings on the pages; elsewhere, see "
            "worldpose locate-cameras, or add the cameras to calibration.toml"
        )
    elif missing:
        line(f"to be clicked first: {', '.join(missing)}; worldpose review serve shows the pages")
