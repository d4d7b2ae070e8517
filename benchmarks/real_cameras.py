"""Cameras of real stills without a click, and of real moving clips."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import (
    clone_repository,
    distances_to_polyline,
    fetch_file,
    git,
    quantile,
    read_image,
    tell,
)
from registry import DATA, Table, Tables, benchmark, option

from data_contracts.arrays import Floats, Image
from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.pitch import PitchSpec
from worldpose.broadcast_calibration.estimate import BroadcastClip, calibrate_broadcast
from worldpose.broadcast_calibration.key_frames import propose_key_frames
from worldpose.broadcast_calibration.report import BroadcastCalibration
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.ingest.validation import validate_record
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.from_paint.proposal import calibrate_proposal, propose_camera
from worldpose.static_calibration.sides import turn_camera
from worldpose.video.folder import open_video

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "real"))
import cut_clip

LABELS = Path(__file__).parents[1] / "tests" / "real" / "stills" / "markings.json"

WIDTH = 960.0
"""Width to which all distances refer [px]."""

PIXELS = (5.0, 10.0, 20.0)
"""Largest distances of right markings [px]."""

SEEN = 40.0
"""Length in the image from which a projected marking has to be labelled [px]."""

BORDER = 0.02
"""Border of the image where a projected marking need not be labelled, in widths [1]."""

REPOSITORY, FOLDER = "DonsetPG/narya", "test_img"

COMMIT = "a26438e9dae091e016813f675d2f37dbcbe6c84d"

FRAMES, FPS = 51, 25.0

PROPOSED_FRAMES = 8
"""Frames in which the stage proposes key frames [1]."""

SIZE = (910, 512)
"""Width, height of the restored images [px]."""

SQUEEZED = 512
"""Width of the images as published [px]."""

DRAWN = Path(__file__).parents[1] / "tests" / "real" / "broadcast_clip"

FIRST, SECOND = "drawn_first.json", "drawn_second.json"

Row = tuple[int, str, float, float, Floats]


@benchmark(
    "still_cameras",
    "cameras without a click in real stills, against labelled markings",
    DATA,
    option("--fetch", action="store_true", help="get the stills first, into DATA/still_cameras"),
    option("--half", choices=("tuned", "held")),
    option("--only", nargs="*", default=()),
)
def score_stills(options: Namespace) -> Tables:
    """Each still is calibrated as the stage of a static camera does, with the side `near`.

    Labels (tests/real/stills/markings.json): pixels on every painted line and arc in view but
    corner arcs, named by eye. Markings that cannot be told by eye are `unsure` and count neither
    way. Cameras of the half `held` changed no method.

    JaC@5 is that of the data sets of drawn lines: right / (right + wrong + missing) markings of an
    image. A marking is right if all its labelled pixels are within 5 px of its projection at a
    width of 960. One that is projected for 40 px or more and not labelled is wrong. A camera is
    wrong if half of its labelled markings are not right, at 20 px.
    """
    if options.fetch:
        fetch_stills(options.data)
    stills, scores = read_labels(options.half, options.only), list[tuple[str, Score]]()
    for still in stills:
        picture = cv2.imread(str(options.data / "still_cameras" / f"{still['name']}.png"))
        if picture is None:
            raise SystemExit(f"expected {still['name']}.png in {options.data}: use --fetch")
        rgb = np.asarray(np.ascontiguousarray(picture[..., ::-1]), np.uint8)
        scores.append((still["half"], score_still(rgb, still)))
        tell(f"{still['name']}: {scores[-1][1]}")
    rows = []
    for half in ("tuned", "held", "all"):
        some = [each for kind, each in scores if half in (kind, "all")]
        used = [each for each in some if each.accepted]
        if used:
            row = [half, len(some), 100.0 * len(used) / len(some), sum(s.wrong for s in some)]
            for group in (used, some):
                row += (100.0 * np.mean([each.jaccard for each in group], axis=0)).tolist()
            rows.append([*row, float(np.median([each.seconds for each in some]))])
    columns = ["half", "stills", "calibrated [%]", "wrong"]
    columns += [f"JaC@{p:g} {of} [%]" for of in ("of these", "of all") for p in PIXELS]
    title = f"{len({still['camera'] for still in stills})} cameras"
    return {"stills": Table(title, [*columns, "time [s]"], rows)}


def fetch_stills(data: Path) -> None:
    """Write the stills to `data/still_cameras`; some are frames of videos."""
    out = data / "still_cameras"
    out.mkdir(parents=True, exist_ok=True)
    for still in read_labels():
        content = fetch_file(
            data / "stills_repositories",
            *(still[name] for name in ("repository", "commit", "path")),
        )
        if "frame" in still:
            (out / "video.mp4").write_bytes(content)
            with open_video(out / "video.mp4") as video:
                picture = video.frame(still["frame"])[..., ::-1]
            (out / "video.mp4").unlink()
        else:
            picture = read_image(content)
        size = tuple(still["size"])
        if picture.shape[1::-1] != size:  # squeezed pixels
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC), np.uint8)
        cv2.imwrite(str(out / f"{still['name']}.png"), picture)


@dataclass(frozen=True, eq=False)
class Score:
    """One still.

    Attributes:
        accepted: whether the camera is used without a click.
        jaccard: JaC at each of `PIXELS` [1]; 0 where there is no camera.
        wrong: whether it is accepted and wrong.
        seconds: time.
        reason: why it is not accepted, or the markings that are not right.
    """

    accepted: bool
    jaccard: Floats
    wrong: bool
    seconds: float
    reason: str


def read_labels(half: str | None = None, only: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return the labelled stills."""
    stills: list[dict[str, Any]] = json.loads(LABELS.read_text(encoding="utf-8"))["stills"]
    return [
        still
        for still in stills
        if (half is None or still["half"] == half) and (not only or still["name"] in only)
    ]


def project_markings(camera: Camera, pitch: PitchTemplate) -> dict[str, Floats]:
    """Return the visible part of each line and arc (n, 2), in pixels of the image."""
    size, found = camera.image_size, {}
    for name in (*pitch.lines, *pitch.arcs):
        if name.startswith("corner_arc"):
            continue
        pixels = camera.project(pitch.marking_points(name, 0.1))
        inside = np.asarray(((pixels > -2.0) & (pixels < size + 1.0)).all(axis=1))
        if np.count_nonzero(inside) >= 2:
            found[name] = np.where(inside[:, None], pixels, np.nan)
    return found


def compare(
    camera: Camera, pitch: PitchTemplate, still: Mapping[str, Any]
) -> tuple[Floats, list[str]]:
    """Return JaC at each of `PIXELS`, and the markings that are not right at the first."""
    scale = WIDTH / float(camera.image_size[0])
    projected, labelled = project_markings(camera, pitch), still["markings"]
    off = {}
    for name, pixels in labelled.items():
        away = np.array([np.inf])
        if name in projected:
            line = projected[name][np.isfinite(projected[name]).all(axis=1)]
            away = np.linalg.norm(np.array(pixels)[:, None] - line, axis=-1).min(axis=1)
        off[name] = float(away.max()) * scale
    border = BORDER * float(camera.image_size[0])
    extra = []
    for name, line in projected.items():
        if name in labelled or name in still.get("unsure", ()):
            continue
        inner = np.asarray(((line > border) & (line < camera.image_size - border)).all(axis=1))
        step = np.linalg.norm(np.diff(line, axis=0), axis=1)
        if float(np.nansum(step[inner[1:] & inner[:-1]])) * scale > SEEN:
            extra.append(name)
    errors = np.array(list(off.values()))
    shares = np.array([(errors <= limit).mean() for limit in PIXELS])
    shares = shares * len(errors) / (len(errors) + len(extra))
    bad = [f"{name} {away:.0f} px" for name, away in off.items() if away > PIXELS[0]]
    return shares, [*bad, *(f"{name} is not there" for name in extra)]


def score_still(picture: Image, still: Mapping[str, Any]) -> Score:
    """Return the score of one still, and write an overlay."""
    pitch, start = PitchTemplate.standard(), time.perf_counter()
    try:
        found = calibrate_proposal(pitch, propose_camera(picture, pitch, side="near"), picture)
    except InputError as refused:
        seconds = time.perf_counter() - start
        return Score(False, np.zeros(len(PIXELS)), False, seconds, refused.found)
    seconds = time.perf_counter() - start
    if found.report.lines is not None:
        pitch = pitch.with_surface(found.report.lines.estimate.surface)
    camera = found.estimate.camera
    either = [compare(each, pitch, still) for each in (camera, turn_camera(camera))]
    shares, bad = max(either, key=lambda each: float(each[0].sum()))
    return Score(True, shares, bool(shares[-1] < 0.5), seconds, ", ".join(bad))


@benchmark(
    "broadcast_clip",
    "the camera of a real broadcast clip, against lines drawn by hand",
    DATA,
    option("--fetch", action="store_true", help="get the clip first, into DATA/broadcast_clip"),
    option("--proposed", action="store_true", help="without a click"),
)
def score_clip(options: Namespace) -> Tables:
    """51 frames of a league match from the repository of narya (MIT), squeezed to 512 x 512.

    Key frames (0, 25, 50) are clicked and drawn, and further six frames drawn twice, off
    enlargements by eye (tests/real/broadcast_clip); the second drawing was made without the first.
    Distances are across the lines, in the columns of the squeezed images, beside what the camera
    states there. `--proposed`: key frames are proposed in eight frames, as the stage does.
    """
    folder = options.data / "broadcast_clip"
    if options.fetch:
        fetch_clip(folder)
    found, rows = calibrate(folder, proposed=options.proposed), []
    for title, pitch in (
        ("the Laws' markings", PitchTemplate.standard()),
        ("the Laws' markings on the estimated surface", estimated_surface(found)),
        ("the estimated markings", estimated_pitch(found)),
    ):
        for name in (FIRST, SECOND):
            values = [row[2:4] for row in distances(found, pitch, read_drawn(name))]
            off, stated = np.transpose(values)
            rms = [float(np.sqrt(np.mean(each**2))) for each in (off, stated)]
            inside = 100.0 * float(np.mean(abs(off) < 1.96 * stated))
            numbers = [np.mean(abs(off)), quantile(abs(off)), quantile(abs(off), 0.95)]
            rows.append([f"{title}, {name}", len(off), *numbers, *rms, inside])
    std = np.sqrt(np.diag(found.uncertainty.clip))[:3]
    center = [["centre", *found.camera.center], ["standard deviation", *std]]
    columns = ["markings", "pixels", "mean", "median", "95 %", "rms", "stated rms"]
    stated_px = quantile(found.report.reprojection_error)
    return {
        "lines": Table("distances [px of 512]", [*columns, "in 95 % regions [%]"], rows),
        "centre": Table("camera", ["of", "x", "y", "z"], center, "m"),
        "stated": Table("expected error", ["of", "median"], [["image", stated_px]], "px of 910"),
    }


@benchmark(
    "broadcast_cuts",
    "moving cameras that are cut out of the two real static ones",
    DATA,
    option("--proposed", action="store_true", help="without a click"),
    option("--side", action="append", choices=("left", "right")),
    option("--move", action="append", choices=tuple(cut_clip.MOVES)),
)
def score_cuts(options: Namespace) -> Tables:
    """150 frames each (tests/real/cut_clip.py) pan, zoom or do both; DATA holds `static_pair`.

    Key frames have the static cameras' own clicks. Lines: distance of markings from those of the
    static camera, which its clicks and lines place on a surface of its own, along the estimated
    surface; places: distance of visible places of the pitch. Pixels are of 1280 columns.
    """
    rows = []
    for side, move in product(options.side or ("left", "right"), options.move or cut_clip.MOVES):
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            true = cut_clip.write_moving_clip(options.data / "static_pair", side, move, folder)
            found, lines = calibrate_cut(folder, proposed=options.proposed)
        center, off_lines, off_places = errors_of_cut(found, lines, true)
        std = float(np.sqrt(np.trace(found.uncertainty.clip[:3, :3])))
        row = [f"{side} {move}", center, std, off_lines.mean(), quantile(off_lines, 0.95)]
        stated = quantile(found.report.reprojection_error)
        rows.append([*row, quantile(off_places), stated])
    columns = ["clip", "centre [m]", "stated [m]", "lines, mean [px]", "lines, 95 % [px]"]
    return {"clips": Table("cut clips", [*columns, "places [px]", "stated [px]"], rows)}


def fetch_clip(out: Path) -> None:
    """Write the frames, restored to 16:9, as `out/frames/NNN.png`."""
    (out / "frames").mkdir(parents=True, exist_ok=True)
    clone = clone_repository(out, REPOSITORY)
    names = git("-C", clone, "ls-tree", "-z", "--name-only", f"{COMMIT}:{FOLDER}")
    for name in names.decode().strip("\0").split("\0"):
        frame = int(name.removesuffix(".jpg").rpartition("_")[2])
        picture = read_image(fetch_file(out, REPOSITORY, COMMIT, f"{FOLDER}/{name}"))
        wide = cv2.resize(picture, SIZE, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / "frames" / f"{frame:03d}.png"), wide)


def write_match(data: Path, folder: Path) -> None:
    """Write a match folder of the broadcast camera alone, with links to the frames."""
    clicks = folder / "annotations" / "broadcast_calibration"
    clicks.mkdir(parents=True)
    (clicks / "goal.json").write_bytes((DRAWN / "clicks.json").read_bytes())
    (folder / "frames").mkdir()
    for image in sorted((data / "frames").glob("*.png")):
        (folder / "frames" / image.name).hardlink_to(image)
    width, height = SIZE
    camera = {"id": "main", "kind": "broadcast", "width": width, "height": height}
    match = {
        "contract": 1,
        "match_id": "broadcast-clip",
        "fps": FPS,
        "cameras": [{**camera, "video": "frames"}],
        "clips": [{"id": "goal", "frame_count": FRAMES, "broadcast": "main"}],
    }
    (folder / "match.yaml").write_text(json.dumps(match))


def read_drawn(name: str) -> KeyFrames:
    """Return clicks and drawn lines of a file."""
    return KeyFrames.model_validate_json((DRAWN / name).read_text())


def calibrate(data: Path, *, proposed: bool = False) -> BroadcastCalibration:
    """Return the clip's camera, from its key frames, clicked or proposed."""
    return _calibrate(data / "frames", read_drawn("clicks.json"), FPS, proposed=proposed)


def _calibrate(video: Path, keys: KeyFrames, fps: float, *, proposed: bool) -> BroadcastCalibration:
    """Return a video's camera from its key frames, or from as many as the stage proposes."""
    chosen, pitch = [*keys.key_frames], PitchTemplate.standard()
    with open_video(video) as opened:
        pictures = [picture for _, picture in opened.frames(grey=True)]
        if proposed:
            numbers = np.linspace(0, len(pictures) - 1, PROPOSED_FRAMES).astype(int).tolist()
            shown = [next(opened.frames(number, number + 1)) for number in numbers]
            chosen = propose_key_frames(shown, pitch, side="near", where=str(video))
    clip = BroadcastClip(chosen, lambda: iter(pictures), fps, proposed=proposed)
    return calibrate_broadcast(pitch, clip)


def estimated_pitch(found: BroadcastCalibration) -> PitchTemplate:
    """Return the pitch with the size and the markings that the fit shows."""
    keys: dict[str, Any] = found.report.pitch.keys or {}
    return PitchTemplate.from_spec(PitchSpec.model_validate({**keys, "any_size": True}))


def estimated_surface(found: BroadcastCalibration) -> PitchTemplate:
    """Return the Laws' markings on the surface that the fit shows."""
    return PitchTemplate.standard().with_surface(found.report.pitch.surface)


def distances(found: BroadcastCalibration, pitch: PitchTemplate, drawn: KeyFrames) -> list[Row]:
    """Return frame, marking, signed distance, its stated deviation and its slopes per drawn pixel.

    A distance is from the projected marking to the pixel, positive below it [px of 512 columns].
    Slopes are by the frame's parameters, in the order of `found.uncertainty.frame`.
    """
    squeeze = np.array([SQUEEZED / SIZE[0], 1.0])
    rows = []
    for key in drawn.key_frames:
        camera = found.camera.camera[key.frame]
        for marking in key.markings.drawn:
            world = pitch.marking_points(marking.name, 0.05)
            line = camera.project(world) * squeeze
            for pixel in marking.xy:
                off = np.array(pixel) * squeeze - line
                nearest = int(np.nanargmin((off**2).sum(axis=1)))
                ends = line[[max(0, nearest - 1), min(len(line) - 1, nearest + 1)]]
                along = ends[1] - ends[0]
                normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
                normal *= np.sign(normal[1])
                place = world[nearest][None]
                by_frame = found.camera.project_with_jacobian(key.frame, place)[1][0]
                slopes = normal * squeeze @ by_frame
                std = np.sqrt(slopes @ found.uncertainty.frame[key.frame] @ slopes)
                distance = float(off[nearest] @ normal)
                rows.append((key.frame, marking.name, distance, float(std), slopes))
    return rows


def calibrate_cut(
    folder: Path, *, proposed: bool = False
) -> tuple[BroadcastCalibration, KeyFrames]:
    """Return the camera of a clip that `cut_clip` wrote, and the clip's lines."""
    keys, lines = (
        validate_record(KeyFrames, json.loads((folder / f"{name}.json").read_text()), name)
        for name in ("key_frames", "lines")
    )
    return _calibrate(folder / "clip.mp4", keys, cut_clip.FPS, proposed=proposed), lines


def errors_of_cut(
    found: BroadcastCalibration, lines: KeyFrames, true: cut_clip.CutClip
) -> tuple[float, Floats, Floats]:
    """Return errors of the centre [m], of lines (n,) and of visible places (m,) [px]."""
    shown = PitchTemplate.standard().with_surface(found.report.pitch.surface)
    places = np.stack(np.meshgrid(np.arange(-52.0, 53.0, 3.0), np.arange(-33.0, 34.0, 3.0)), -1)
    places = places.reshape(-1, 2)
    places = np.column_stack([places, true.pitch.height(*places.T)])
    off_lines, off_places = [], []
    for key in lines.key_frames:
        camera = found.camera.camera[key.frame]
        for marking in key.markings.drawn:
            line = camera.project(shown.marking_points(marking.name, 0.1))
            off_lines.append(distances_to_polyline(np.array(marking.xy), line))
        seen = true.cameras[key.frame].project(places)
        seen, at = (each[cut_clip.inside(seen, cut_clip.SIZE)] for each in (seen, places))
        off_places.append(np.linalg.norm(camera.project(at) - seen, axis=1))
    center = float(np.linalg.norm(found.camera.center - true.static.center))
    return center, np.concatenate(off_lines), np.concatenate(off_places)
