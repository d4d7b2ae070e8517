"""Every metric on real data in one table.

    python benchmarks/real.py DATA [--only NAME ...] [--json] [--frames N]

DATA is a folder with any of these; what is absent is skipped:

- `static_pair`: left_camera.mp4, right_camera.mp4, left_keypoints.xml, right_keypoints.xml (two
  cameras on one mast, clicks of CVAT whose known wrong names tests/real/static_pair.py lists);
- `panorama_people`, `shelf_dev`, `mvor`: see `run.py NAME --help` of panorama_people, shelf, mvor;
- `moving_clip`: one video of a moving broadcast camera, `key_frames.json` (clicks in the form of
  annotations/broadcast_calibration), optionally `lines.json` (drawn lines in the same form, which
  are scored and not fitted; without it those of the key frames are scored) and `pitch.json`.
  Markings are where the Laws or pitch.json have them, on the surface that the fit shows;
- `stills`: images, and one JSON file with boxes and 17 joints of people in COCO form.

Left out: each click in turn, predicted by the camera of the others, with the names of the places
that were clicked. Wrong names found and right clicks rejected: with the names as given. Feet: both
cameras are calibrated on one pitch, and each alone tracks people on it; per frame, mutual nearest
neighbours within 2 m are compared, after the clock offset that makes them agree best. Errors count
from 8 pairs per frame on: fewer people are easier. Recall and precision: boxes of the detector from
its high score threshold on, at an IoU of 0.5. PCK: visible joints within a fifth of the torso, in
the labelled boxes. `--frames N` takes N frames, stills, moments or left-out clicks of each part: a
quick look, not a result.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mvor
import numpy as np
import shelf
import stills
from common import distances_to_polyline, quantile, run_in_process
from registry import (
    DATA,
    REGISTRY,
    Table,
    Tables,
    as_data,
    benchmark,
    flatten,
    format_table,
    option,
)
from scipy.spatial import KDTree

from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.broadcast_calibration.estimate import BroadcastClip, calibrate_broadcast
from worldpose.detection.models import load_pose
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError, WorldposeError
from worldpose.formats.files import read_json
from worldpose.ingest.validation import validate_record
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.line_refinement import LineRefinement
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.venue import join_cameras
from worldpose.store.store import Store
from worldpose.tracking.plane.feet import locate_feet
from worldpose.tracking.plane.tracker import track_on_plane
from worldpose.tracking.settings import TrackingSettings
from worldpose.training.labels import PictureCache, read_labels
from worldpose.training.metrics import score_keypoints
from worldpose.video.folder import index_video, open_video

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "real"))
import static_pair

from data_contracts.arrays import Floats, Image

Metrics = dict[str, Any]

PAIR_M = 2.0
"""Largest distance of two cameras' positions of one person [m]."""
WANTED_PAIRS = 8.0
"""Least number of pairs per frame from which distances of feet are comparable."""
MAX_OFFSET_FRAMES = 3.0
"""Largest clock offset between the cameras of the static pair, beyond the stated one [frame]."""
FPS = 25.0  # of the static pair
VIDEOS = (".mp4", ".mov", ".mkv", ".avi")


def calibrate_pair(
    places: Mapping[str, Floats], pixels: Mapping[str, Sequence[float]]
) -> StaticCalibration:
    """Return one camera of the static pair from its clicks."""
    points = {name: tuple(place) for name, place in places.items()}
    pitch = PitchTemplate.from_spec(PitchSpec(crown=static_pair.CROWN, points=points))
    clicked = [{"name": name, "xy": pixel} for name, pixel in pixels.items()]
    markings = ClickedMarkings.model_validate({"points": clicked})
    return calibrate_camera(pitch, markings, static_pair.SIZE)


def score_clicks(folder: Path, side: str, count: int | None) -> Metrics:
    """Return the error of left-out clicks (the first `count`), and judged wrong names."""
    places, pixels = static_pair.read_clicks(folder, side)
    height = PitchTemplate.from_spec(PitchSpec(crown=static_pair.CROWN)).height
    off = []
    for name, pixel in list(pixels.items())[:count]:
        camera = calibrate_pair(places, {n: p for n, p in pixels.items() if n != name})
        x, y = places[name]
        projected = camera.estimate.camera.project([[x, y, float(height(x, y))]])[0]
        off.append(np.linalg.norm(projected - pixel))
    said, as_given = static_pair.read_clicks(folder, side, correct_labels=False)
    true = {tuple(pixel): places[name] for name, pixel in pixels.items()}
    wrong = {
        name
        for name, pixel in as_given.items()
        if np.linalg.norm((said[name] - true[tuple(pixel)])[:2]) > 0.5
    }
    rejected = {p.name for p in calibrate_pair(said, as_given).report.points if not p.inlier}
    return {
        "left_out_px_median": float(np.median(off)),
        "wrong_named": len(rejected & wrong),
        "wrong_names": len(wrong),
        "right_accused": len(rejected - wrong),
    }


def score_lines(folder: Path, side: str, count: int | None) -> Metrics:
    """Return the error of left-out painted markings (the first `count`).

    Each marking is taken off the pitch, the camera is calibrated on all others and the clicks, and
    its projection is compared with the paint that the calibration with all markings found.
    """
    pitch, clicks = static_pair.clicked_pitch(folder, side)
    still = static_pair.median_still(folder, side)
    bars = _find_lines(pitch, clicks, still).bars
    assert bars is not None  # the camera was refined
    off, deviations = [], []
    for number in np.unique(bars.samples.marking)[:count]:
        mine, name = bars.samples.marking == number, bars.samples.names[number]
        lines = {key: line for key, line in pitch.lines.items() if key != name}
        arcs = {key: arc for key, arc in pitch.arcs.items() if key != name}
        without = _find_lines(replace(pitch, lines=lines, arcs=arcs), clicks, still).estimate
        own = replace(
            bars,
            samples=bars.samples[mine],
            pixels=bars.pixels[mine],
            noise=bars.noise[mine],
            by_paint=bars.by_paint[mine],
            unknowns=bars.unknowns[mine],
        )
        whitened, moves = own.whiten_raw(without.camera, without.surface)
        variance = 1.0 + np.einsum("ni,ij,nj->n", moves, without.covariance, moves)
        variance += ((own.by_paint / own.noise[:, None]) ** 2).sum(axis=1)
        off.append(np.abs(whitened) * own.noise)
        deviations.append(np.abs(whitened) / np.sqrt(variance))
    return {
        "left_out_line_px_median": float(np.median(np.concatenate(off))),
        "left_out_line_in_region": float((np.concatenate(deviations) < 1.96).mean()),
    }


def _find_lines(pitch: PitchTemplate, clicks: ClickedMarkings, still: Image) -> LineRefinement:
    lines = calibrate_camera(pitch, clicks, static_pair.SIZE, picture=still).report.lines
    if lines is None or not lines.refined:
        raise WorldposeError(f"static pair: the lines were not used: {lines and lines.reason}")
    return lines


def track_sides(
    folder: Path, frames: int, work: Path, *, clicked: bool = True
) -> tuple[Metrics, list[Floats]]:
    """Return metrics of the calibrations, and where each camera alone places people.

    Without clicks both cameras are proposed from their videos. Places are (frames, persons, 2) [m]
    of each side; NaN where missing. If a camera is refused: the reason, and no places.
    """
    match = work / "match"
    static_pair.write_static_pair(folder, match, first_frame=0, frame_count=frames, clicked=clicked)
    store = Store.create(work / "project")
    name, (keys,) = run_in_process(store, match, "static_calibration", 1, {})
    for side in static_pair.SIDES:
        key = keys[f"static_calibration/{side}"]
        left_out = store.manifest(name, "static_calibration", side, key).left_out
        if left_out:
            return {"not_calibrated": left_out[side]}, []
    name, (keys,) = run_in_process(store, match, "detection", 1, {})

    def result(stage: str, unit: str) -> Any:
        return store.open_result(name, stage, unit, keys[f"{stage}/{unit}"])

    known = [result("static_calibration", side) for side in static_pair.SIDES]
    venue = join_cameras([each.data_vars for each in known])
    pitch = PitchTemplate.from_spec(PitchSpec(crown=static_pair.CROWN))
    metrics: Metrics = {"with_lines": sum(each.attrs["origin"] == "lines" for each in known)}
    if venue.surface is not None:
        pitch = pitch.with_surface(venue.surface.shape)
        metrics["crown_m"], metrics["end_fall_m"] = venue.surface.shape.tolist()
    places = []
    for index, side in enumerate(static_pair.SIDES):
        seen = result("detection", f"{side}.clip")
        feet = locate_feet(
            venue.cameras[index : index + 1],
            KeypointDetections.stack([KeypointDetections.from_arrays(seen)]),
            pitch,
            camera_covariance=venue.covariance[index : index + 1],
        )
        tracks = track_on_plane(feet, FPS, pitch_size=(pitch.length, pitch.width))
        places.append(tracks.xy)
    return metrics, places


def pair_feet(first: Floats, second: Floats, offset: float) -> list[Floats]:
    """Return the distances of pairs [m] in each frame, the second camera's taken `offset` later."""
    before = int(np.floor(offset))
    found = []
    for frame in range(len(first)):
        if not 0 <= frame + before < len(second) - 1:
            continue
        share = offset - before
        here = first[frame]
        there = (1.0 - share) * second[frame + before] + share * second[frame + before + 1]
        a, b = (places[np.isfinite(places[:, 0])] for places in (here, there))
        if not len(a) or not len(b):
            found.append(np.empty(0))
            continue
        distance, nearest = KDTree(b).query(a)
        _, back = KDTree(a).query(b)
        mutual = (back[nearest] == np.arange(len(a))) & (distance <= PAIR_M)
        found.append(distance[mutual])
    return found


def score_static_pair(folder: Path, frames: int | None) -> Metrics:
    """Return metrics of both cameras' clicks, and of the feet of people in both images."""
    files = [
        f"{side}_{name}" for side in static_pair.SIDES for name in ("camera.mp4", "keypoints.xml")
    ]
    _require(folder, files)
    whole = min(
        len(index_video(folder / f"{side}_camera.mp4")) - offset
        for side, offset in static_pair.SIDES.items()
    )
    count = whole if frames is None else min(frames, whole)
    metrics: Metrics = {
        side: score_clicks(folder, side, frames) | score_lines(folder, side, frames)
        for side in static_pair.SIDES
    }
    for clicked in (True, False):
        with tempfile.TemporaryDirectory() as temporary:
            found, places = track_sides(folder, count, Path(temporary), clicked=clicked)
        if places:
            found |= _score_feet(*places)
        metrics |= found if clicked else {"without_clicks": found}
    return metrics


def _score_feet(left: Floats, right: Floats) -> Metrics:
    """Return distances of the same feet under the clock offset that fits best."""
    offsets = np.arange(-MAX_OFFSET_FRAMES, MAX_OFFSET_FRAMES + 0.05, 0.1)
    by_offset = [pair_feet(left, right, float(offset)) for offset in offsets]
    by_offset = [frames for frames in by_offset if frames]
    medians = [quantile(np.concatenate(frames)) for frames in by_offset]
    best = by_offset[int(np.argmin(np.nan_to_num(medians, nan=np.inf)))]
    pairs = np.concatenate(best)
    return {
        "feet_m_median": quantile(pairs),
        "feet_m_p95": quantile(pairs, 0.95),
        "people_per_frame": len(pairs) / len(best),
    }


def score_panorama(folder: Path, frames: int | None) -> Metrics:
    """Return AP50 of small people in a panorama."""
    return {"ap50": stills.measure(folder, DetectionSettings(), frames)["ap50"]}


def score_shelf(folder: Path, frames: int | None) -> Metrics:
    """Return PCP3D of joints, bodies and the export of the Shelf sequence [%]."""
    _require(folder, ["import/calibration.toml", "import/detections", "gt.npz", "pcp.py"])
    window = shelf.ALL_FRAMES
    if frames is not None:
        files = sorted((folder / "import" / "detections").glob("*.json"))
        first = min(one["image_id"] for file in files for one in json.loads(file.read_text()))
        window = range(first, first + frames)
    with tempfile.TemporaryDirectory() as temporary:
        out, cameras = Path(temporary), shelf.list_cameras(folder)
        match = shelf.write_case(folder / "import", cameras, window, out)
        joints, bodies, seen, exported = shelf.scores(folder, match, out)
    return {
        "joints_pcp3d_percent": joints,
        "bodies_pcp3d_percent": bodies,
        "bodies_as_detected_pcp3d_percent": seen,
        "exported_joints_pcp3d_percent": exported,
    }


def score_moving_clip(folder: Path, frames: int | None) -> Metrics:
    """Return the distance of drawn lines to the projected ones, and the camera's centre."""
    _require(folder, ["key_frames.json"])
    videos = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in VIDEOS]
    if len(videos) != 1:
        raise InputError(
            str(folder),
            expected="one video",
            found=", ".join(file.name for file in videos) or "none",
            todo="Keep the video of the moving camera there, and no other.",
        )
    clicks, lines = folder / "key_frames.json", folder / "lines.json"
    keys, drawn = (
        validate_record(KeyFrames, read_json(file), str(file))
        for file in (clicks, lines if lines.exists() else clicks)
    )
    pitch = PitchTemplate.standard()
    if (folder / "pitch.json").exists():
        given = read_json(folder / "pitch.json")
        pitch = PitchTemplate.from_spec(
            validate_record(PitchSpec, given, str(folder / "pitch.json"))
        )
    index = index_video(videos[0])
    count = len(index) if frames is None else min(frames, len(index))

    def pictures() -> Iterator[Image]:
        with open_video(videos[0], index) as video:
            yield from (picture for _, picture in video.frames(0, count, grey=True))

    clip = BroadcastClip(
        [key for key in keys.key_frames if key.frame < count],
        pictures,
        index.fps,
        where=str(folder / "key_frames.json"),
    )
    calibration = calibrate_broadcast(pitch, clip)
    shown = pitch.with_surface(calibration.report.pitch.surface)
    off = []
    for key in drawn.key_frames:
        if key.frame >= count:
            continue
        camera = calibration.camera.camera[key.frame]
        for marking in key.markings.drawn:
            line = camera.project(shown.marking_points(marking.name, 0.1))
            off.append(distances_to_polyline(np.array(marking.xy), line))
    if not off:
        raise InputError(
            str(lines if lines.exists() else folder / "key_frames.json"),
            expected="drawn lines",
            found=f"none in the first {count} frames",
            todo="Draw lines in some frames: `drawn` of their markings.",
        )
    pixels = np.concatenate(off)
    return {
        "lines_px_mean": float(pixels.mean()),
        "lines_px_p95": float(np.quantile(pixels, 0.95)),
        "stated_px": float(np.nanmedian(calibration.report.reprojection_error)),
        "center_m": calibration.camera.center.tolist(),
    }


def score_stills(folder: Path, frames: int | None) -> Metrics:
    """Return recall, precision and PCK of the bundled nets on labelled stills."""
    files = sorted(folder.glob("*.json"))
    if len(files) != 1:
        raise InputError(
            str(folder),
            expected="one JSON file with labels in COCO form",
            found=", ".join(file.name for file in files) or "none",
            todo="Keep the labels of all stills in one file.",
        )
    labelled = read_labels(files[0])
    if not (folder / labelled[0].path.name).exists() and (folder / "images").is_dir():
        labelled = read_labels(files[0], folder / "images")
    labelled, settings = labelled[:frames], DetectionSettings()
    found = stills.detect_people(labelled, settings)
    boxes = stills.score_boxes(found, labelled, settings.high_score_threshold)
    pck = score_keypoints(load_pose(settings), labelled, PictureCache(1 << 28)).pck
    return {"recall": boxes["recall"], "precision": boxes["precision"], "pck": pck}


def score_mvor(folder: Path, frames: int | None) -> Metrics:
    """Return errors and shares of people of an operating room, with three and with two views."""
    _require(folder, ["camma_mvor_2018.json", "openpose_kps.json"])
    cameras, moments = mvor.load_moments(folder)
    result = mvor.measure(cameras, moments[:frames], TrackingSettings())
    metrics: Metrics = {}
    for name, views in (("three", 3), ("two", 2)):
        errors, people = result["errors"][views], result["people"][views]
        placed = result["results"][views]
        metrics[name] = {
            "error_cm": float(mvor.mean_error(errors).mean()),
            "matched_percent": 100.0 * len(errors) / people if people else math.nan,
            **{
                f"{title}_percent": 100.0 * result[name][views] / placed if placed else math.nan
                for title, name in (("false", "false"), ("unknown", "unknown"), ("beyond", "extra"))
            },
        }
    return metrics


def _require(folder: Path, names: Sequence[str]) -> None:
    for name in names:
        if not (folder / name).exists():
            raise InputError(
                str(folder / name),
                expected="this part of the data",
                found="nothing",
                todo=f"Complete the folder {folder.name}, or remove it to skip its metrics.",
            )


PARTS: dict[str, Callable[[Path, int | None], Metrics]] = {
    "static_pair": score_static_pair,
    "panorama_people": score_panorama,
    "shelf_dev": score_shelf,
    "moving_clip": score_moving_clip,
    "mvor": score_mvor,
    "stills": score_stills,
}
"""Return metrics of a part from its folder and the number of frames; None = all."""
NOTES = {
    "feet_m_median": "0.15 wanted",
    "feet_m_p95": "0.5 wanted",
    "people_per_frame": f"pairs; {WANTED_PAIRS:g} or more wanted, or feet are not comparable",
    "stated_px": "expected error, median over frames",
    "three.error_cm": "9.9 published (mv3dreg)",
    "two.error_cm": "18.3 published (mv3dreg)",
}


def measure(data: Path, only: Sequence[str], frames: int | None) -> dict[str, Any]:
    """Return metrics by part, and under `skipped` why others have none."""
    chosen = [name for name in PARTS if not only or name in only]
    there = [name for name in chosen if (data / name).is_dir()]
    if not there:
        raise InputError(
            str(data),
            expected=f"a folder with {' or '.join(chosen)}",
            found="none of them" if data.is_dir() else "no such folder",
            todo="Name the folder that holds them; benchmarks/real.py says how each is laid out.",
        )
    skipped = {name: f"{name} is absent" for name in chosen if name not in there}
    result: dict[str, Any] = {}
    for name in there:
        print(f"{name} ...", file=sys.stderr, flush=True)
        try:
            result[name] = PARTS[name](data / name, frames)
        except (OSError, ValueError, KeyError, ElementTree.ParseError) as error:
            # A file of another form: which one, its reader alone knows.
            raise WorldposeError(f"{name}: {type(error).__name__}: {error}") from error
    return {**result, "skipped": skipped}


@benchmark(
    "real",
    "every metric on real data in one table",
    DATA,
    option("--only", action="append", choices=tuple(PARTS), default=[]),
    option("--frames", type=int, help="frames, stills or moments per part"),
)
def score_parts(options: Namespace) -> Tables:
    """See the head of benchmarks/real.py, which prints the same numbers by itself."""
    return {"metrics": tabulate(measure(options.data, options.only, options.frames))}


def tabulate(result: Mapping[str, Any]) -> Table:
    """Return all metrics as a table, then what was skipped."""
    rows = [
        [name, metric, as_data(value), NOTES.get(metric, "")]
        for name in PARTS
        for metric, value in flatten(result.get(name, {})).items()
    ]
    rows += [[name, "skipped", "", reason] for name, reason in result["skipped"].items()]
    return Table("real data", ["data", "metric", "value", ""], rows)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for names, how in REGISTRY["real"].options:
        parser.add_argument(*names, **how)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.frames is not None and options.frames < 1:
        parser.error("--frames: expected a positive number")
    try:
        result = measure(options.data, options.only, options.frames)
    except WorldposeError as error:
        sys.exit(f"error: {error}")
    table = format_table(tabulate(result))
    print(json.dumps(as_data(result), indent=2) if options.json else table)


if __name__ == "__main__":
    main()
