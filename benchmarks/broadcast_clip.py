"""Compares the camera of a real broadcast clip with lines drawn by hand.

    python benchmarks/broadcast_clip.py fetch DATA
    python benchmarks/broadcast_clip.py score DATA [--proposed]
    python benchmarks/broadcast_clip.py cut DATA [--proposed] [--side left] [--move pan]

The clip: 51 frames of a league match from the repository of narya (MIT), squeezed to 512 x 512
there; `fetch` gets them by git, checks the digest of the folder and restores 16:9. Key frames
(0, 25, 50) are clicked and drawn, and further six frames drawn twice, off enlargements by eye
(tests/real/broadcast_clip); the second drawing was made without the first. Distances are across
the lines, in the columns of the squeezed images; `score` also prints what the camera states there.
`--proposed` takes no click: key frames are proposed in eight frames, as the stage does, with the
side `near`.

`cut` takes moving cameras cut out of the two real static ones in DATA/static_pair, 150 frames each
(tests/real/cut_clip.py): they pan, zoom or do both. Key frames have the static cameras' own clicks.
One line per clip: distance of the centre from the true one, and the stated one; distance of
markings from those of the static camera, which its clicks and lines place on a surface of its own,
along the estimated surface; distance of visible places of the pitch, and the stated one. Pixels are
of 1280 columns.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "real"))
import cut_clip
from common import distances_to_polyline

from data_contracts.arrays import Floats
from data_contracts.broadcast_calibration import KeyFrames
from worldpose.broadcast_calibration.calibration import (
    BroadcastCalibration,
    BroadcastClip,
    calibrate_broadcast,
)
from worldpose.broadcast_calibration.key_frames import propose_key_frames
from worldpose.broadcast_calibration.normal_equations import point_row
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.ingest.validation import validate_record
from worldpose.pitch.template import PitchTemplate
from worldpose.video.folder import open_video

REPOSITORY = "https://github.com/DonsetPG/narya"
COMMIT = "a26438e9dae091e016813f675d2f37dbcbe6c84d"
FOLDER = "test_img"
TREE = "28b4a46a77f33086b844a19ada649bf380d80a72"
"""Git's digest of the folder and all its files."""
FRAMES, FPS = 51, 25.0
PROPOSED_FRAMES = 8
"""Frames in which the stage proposes key frames [1]."""
SIZE = (910, 512)
"""Width, height of the restored images [px]."""
SQUEEZED = 512
"""Width of the images as published [px]."""
DRAWN = Path(__file__).parents[1] / "tests" / "real" / "broadcast_clip"
FIRST, SECOND = "drawn_first.json", "drawn_second.json"


def fetch(out: Path, repository: str = REPOSITORY) -> None:
    """Write the restored frames as `out/frames/NNN.png`.

    Args:
        out: folder to write.
        repository: URL or folder to clone from.

    Raises:
        SystemExit: the folder's digest is another.
    """
    clone = out / "narya"
    if not clone.is_dir():
        _git("clone", "--quiet", "--no-checkout", "--filter=blob:none", repository, str(clone))
    (row,) = _git("-C", str(clone), "ls-tree", COMMIT, FOLDER).decode().splitlines()
    if row.split()[2] != TREE:
        raise SystemExit(f"expected the folder {TREE}, found {row.split()[2]}")
    (out / "frames").mkdir(exist_ok=True)
    names = _git("-C", str(clone), "ls-tree", "-z", "--name-only", f"{COMMIT}:{FOLDER}")
    for name in names.decode().strip("\0").split("\0"):
        number = int(name.removesuffix(".jpg").rpartition("_")[2])
        data = _git("-C", str(clone), "cat-file", "blob", f"{COMMIT}:{FOLDER}/{name}")
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise SystemExit(f"expected {name} to be an image, found bytes that are none")
        wide = cv2.resize(picture, SIZE, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / "frames" / f"{number:03d}.png"), wide)


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], check=True, stdout=subprocess.PIPE).stdout


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


def calibrate(
    data: Path, settings: BroadcastCalibrationSettings | None = None, *, proposed: bool = False
) -> BroadcastCalibration:
    """Return the clip's camera, from its key frames, clicked or proposed."""
    with open_video(data / "frames") as video:
        pictures = [picture for _, picture in video.frames(grey=True)]
        numbers = np.linspace(0, FRAMES - 1, PROPOSED_FRAMES).astype(int).tolist()
        shown = [next(video.frames(number, number + 1)) for number in numbers]
    keys = [*read_drawn("clicks.json").key_frames]
    if proposed:
        start, pitch = time.perf_counter(), PitchTemplate.standard()
        keys = propose_key_frames(shown, pitch, side="near", where=str(data))
        took = time.perf_counter() - start
        print(f"key frames proposed in frames {[key.frame for key in keys]}, {took:.0f} s")
    clip = BroadcastClip(keys, lambda: iter(pictures), FPS, proposed=proposed)
    settings = settings or BroadcastCalibrationSettings()
    return calibrate_broadcast(PitchTemplate.standard(), clip, settings)


def estimated_pitch(found: BroadcastCalibration) -> PitchTemplate:
    """Return the pitch with the size and the markings that the fit shows."""
    spec = found.report.pitch.spec
    return PitchTemplate.standard() if spec is None else PitchTemplate.from_spec(spec)


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
                slopes = normal * squeeze @ _pixel_slopes(found, key.frame, world[nearest])
                std = np.sqrt(slopes @ found.uncertainty.frame[key.frame] @ slopes)
                distance = float(off[nearest] @ normal)
                rows.append((key.frame, marking.name, distance, float(std), slopes))
    return rows


Row = tuple[int, str, float, float, Floats]


def _pixel_slopes(found: BroadcastCalibration, frame: int, place: Floats) -> Floats:
    """Return the slopes (2, 12) of a place's pixel by the parameters of its frame."""
    camera, pixel, by_step = found.camera, np.empty(2), np.empty((2, 12))
    lens = camera.lens(frame)
    point_row(camera.rotation[frame], camera.center, lens, place, pixel, by_step)
    return by_step


def expected_rms(
    found: BroadcastCalibration, rows: list[Row], draws: int = 4000
) -> tuple[Floats, Floats]:
    """Return root mean squares (draws,) of distances that the stated covariance lets expect.

    Pixels of a frame share the error of its camera, and frames share that of centre and pitch: few
    errors make all distances of a clip, and their root mean square varies. The covariance between
    frames is not kept. So there are two draws: one error for all frames (the square roots of their
    covariances are symmetric, so that it acts alike in all), and one per frame.

    Args:
        found: the camera and its covariance.
        rows: of `distances`.
        draws: number of clips.
    """
    rng = np.random.default_rng(0)
    frames = sorted({row[0] for row in rows})
    roots = {}
    for frame in frames:
        values, vectors = np.linalg.eigh(found.uncertainty.frame[frame])
        roots[frame] = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    loads = np.stack([roots[row[0]] @ row[4] for row in rows])
    common = rng.normal(size=(draws, 1, loads.shape[1]))
    apart = rng.normal(size=(draws, len(frames), loads.shape[1]))[
        :, [frames.index(row[0]) for row in rows]
    ]
    together, single = (
        np.sqrt(np.mean((each * loads).sum(axis=-1) ** 2, axis=1)) for each in (common, apart)
    )
    return together, single


def repeatability(one: list[Row], two: list[Row]) -> float:
    """Return the deviation of one drawing of a marking in a frame [px of 512 columns]."""
    means: list[dict[tuple[int, str], float]] = []
    for rows in (one, two):
        groups: dict[tuple[int, str], list[float]] = {}
        for frame, name, off, *_ in rows:
            groups.setdefault((frame, name), []).append(off)
        means.append({key: float(np.mean(each)) for key, each in groups.items()})
    both = means[0].keys() & means[1].keys()
    return float(np.sqrt(np.mean([(means[0][key] - means[1][key]) ** 2 for key in both]) / 2.0))


def score(data: Path, proposed: bool) -> None:
    """Print distances of hand-drawn lines, by drawing and by marking."""
    start = time.perf_counter()
    found = calibrate(data, proposed=proposed)
    print(f"{time.perf_counter() - start:.0f} s for {FRAMES} frames")
    camera, std = found.camera, np.sqrt(np.diag(found.uncertainty.clip))
    print("center {:.2f} {:.2f} {:.2f} m".format(*camera.center), end="")
    print(", standard deviations {:.2f} {:.2f} {:.2f}".format(*std[:3]))
    print("\n".join(found.report.pitch.describe))
    print(f"expected error {np.nanmedian(found.report.reprojection_error):.2f} px of {SIZE[0]}")
    for title, pitch in (
        ("the Laws' markings", PitchTemplate.standard()),
        ("the Laws' markings on the estimated surface", estimated_surface(found)),
        ("the estimated markings", estimated_pitch(found)),
    ):
        drawings = [distances(found, pitch, read_drawn(name)) for name in (FIRST, SECOND)]
        for rows in drawings:
            off, stated = (np.array([row[column] for row in rows]) for column in (2, 3))
            mean, middle, most = np.mean(abs(off)), np.median(abs(off)), np.quantile(abs(off), 0.95)
            print(f"{title}: {len(off)} pixels, mean {mean:.2f} px, median {middle:.2f}", end="")
            rms = np.sqrt(np.mean(off**2)), np.sqrt(np.mean(stated**2))
            print(f", 95 % {most:.2f}, rms {rms[0]:.2f}, stated {rms[1]:.2f}")
            together, single = expected_rms(found, rows)
            inside = 100.0 * np.mean(abs(off) < 1.96 * stated)
            print(f"  {inside:.0f} % of them within 95 % regions; 95 % of clips with", end="")
            for label, each in (("one error", together), ("errors of single frames", single)):
                low, high = np.quantile(each, [0.025, 0.975])
                below = 100.0 * np.mean(each < rms[0])
                print(f" {label} have an rms of {low:.2f} to {high:.2f}", end="")
                print(f", {below:.0f} % a smaller one;", end="")
            print()
        for name in sorted({row[1] for row in drawings[0]}):
            offs = [[row[2] for row in rows if row[1] == name] for rows in drawings]
            print(f"  {name}: mean {np.mean(offs[0]):+.2f}, {np.mean(offs[1]):+.2f} px")
    print(f"repeatability of a drawn marking {repeatability(drawings[0], drawings[1]):.2f} px")


def calibrate_cut(
    folder: Path, *, proposed: bool = False
) -> tuple[BroadcastCalibration, KeyFrames]:
    """Return the camera of a clip that `cut_clip` wrote, and the clip's lines."""
    video = folder / "clip.mp4"
    keys, lines = (
        validate_record(KeyFrames, json.loads((folder / f"{name}.json").read_text()), name)
        for name in ("key_frames", "lines")
    )
    chosen, pitch = [*keys.key_frames], PitchTemplate.standard()
    with open_video(video) as opened:
        pictures = [picture for _, picture in opened.frames(grey=True)]
        if proposed:
            numbers = np.linspace(0, len(pictures) - 1, PROPOSED_FRAMES).astype(int).tolist()
            shown = [next(opened.frames(number, number + 1)) for number in numbers]
            chosen = propose_key_frames(shown, pitch, side="near", where=str(video))
    clip = BroadcastClip(chosen, lambda: iter(pictures), cut_clip.FPS, proposed=proposed)
    return calibrate_broadcast(pitch, clip), lines


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


def score_cuts(data: Path, sides: list[str], moves: list[str], proposed: bool) -> None:
    """Print one line for each clip that is cut out of the static cameras."""
    for side in sides:
        for move in moves:
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch)
                true = cut_clip.write_moving_clip(data / "static_pair", side, move, folder)
                found, lines = calibrate_cut(folder, proposed=proposed)
            center, off_lines, off_places = errors_of_cut(found, lines, true)
            std = float(np.sqrt(np.trace(found.uncertainty.clip[:3, :3])))
            stated = float(np.nanmedian(found.report.reprojection_error))
            print(
                f"{side} {move}: centre {center:.2f} m, stated {std:.2f}; lines "
                f"{off_lines.mean():.2f} px mean, {np.quantile(off_lines, 0.95):.2f} 95 %; places "
                f"{np.median(off_places):.2f} px median, stated {stated:.2f}",
                flush=True,
            )


def main() -> None:
    """Run one of the commands."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=("fetch", "score", "cut"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--repository", default=REPOSITORY)
    parser.add_argument("--proposed", action="store_true")
    parser.add_argument("--side", action="append", choices=("left", "right"))
    parser.add_argument("--move", action="append", choices=tuple(cut_clip.MOVES))
    options = parser.parse_args()
    if options.command == "fetch":
        options.data.mkdir(parents=True, exist_ok=True)
        fetch(options.data, options.repository)
    elif options.command == "cut":
        sides, moves = options.side or ["left", "right"], options.move or [*cut_clip.MOVES]
        score_cuts(options.data, sides, moves, options.proposed)
    else:
        score(options.data, options.proposed)


if __name__ == "__main__":
    main()
