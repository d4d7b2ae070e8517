r"""Scores cameras that are found without a click in real stills.

    python benchmarks/still_cameras.py fetch DATA [--mirror FOLDER]
    python benchmarks/still_cameras.py score DATA [--half tuned|held] [--only NAME ...] \
        [--out OVERLAYS]

`fetch` gets the stills from public repositories by git, at fixed commits, into DATA/still_cameras.
A folder of clones named owner+name takes the place of the network. Some stills are frames of
videos. `score` calibrates each by `calibrate_without_clicks`, as the stage of a static camera does,
with the side `near`: left and right are as the camera sees them, which is what a user states.

Labels (tests/real/stills/markings.json): pixels on every painted line and arc in view but corner
arcs, named by eye. A person named each marking and gave its rough place, in part by confirming
projections; the pixels are peaks of brightness across it, on a smooth curve. Markings that cannot
be told by eye are `unsure` and count neither way. Cameras of the half `held` changed no method.

JaC@5 is that of the data sets of drawn lines (`pitch_lines.py`): right / (right + wrong + missing)
markings of an image. A marking is right if all its labelled pixels are within 5 px of its
projection at a width of 960. One that is projected for 40 px or more and not labelled is wrong. A
camera is wrong if half of its labelled markings are not right, at 20 px.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.proposal import calibrate_without_clicks
from worldpose.static_calibration.sides import turn_camera

LABELS = Path(__file__).parents[1] / "tests" / "real" / "stills" / "markings.json"
GITHUB = "https://github.com/"
WIDTH = 960.0
"""Width to which all distances refer [px]."""
PIXELS = (5.0, 10.0, 20.0)
"""Largest distances of right markings [px]."""
SEEN = 40.0
"""Length in the image from which a projected marking has to be labelled [px]."""
BORDER = 0.02
"""Border of the image where a projected marking need not be labelled, in widths [1]."""


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


def fetch(data: Path, mirror: Path | None) -> None:
    """Write the stills to `data/still_cameras`; git checks the content by its commit."""
    out, clones = data / "still_cameras", mirror or data / "stills_repositories"
    out.mkdir(parents=True, exist_ok=True)
    for still in read_labels():
        clone = clones / still["repository"].replace("/", "+")
        if not clone.is_dir():
            url = f"{GITHUB}{still['repository']}"
            _git("clone", "--quiet", "--no-checkout", "--filter=blob:none", url, str(clone))
        where = next(each for each in (clone / "repo", clone) if each.is_dir())
        content = _git("-C", str(where), "cat-file", "blob", f"{still['commit']}:{still['path']}")
        picture = _decode(content, still.get("frame"), out)
        if picture is None:
            raise SystemExit(f"expected {still['path']} of {still['repository']} to have images")
        size = tuple(still["size"])
        if picture.shape[1::-1] != size:  # squeezed pixels
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / f"{still['name']}.png"), picture)


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], check=True, stdout=subprocess.PIPE).stdout


def _decode(content: bytes, frame: int | None, scratch: Path) -> Any:
    """Return an image file's image, or a frame of a video file; None if there is none."""
    if frame is None:
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    file = scratch / "video.mp4"
    file.write_bytes(content)
    video = cv2.VideoCapture(str(file))
    video.set(cv2.CAP_PROP_POS_FRAMES, frame)
    picture = video.read()[1]
    video.release()
    file.unlink()
    return picture


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


def score_still(picture: Image, still: Mapping[str, Any], out: Path | None) -> Score:
    """Return the score of one still, and write an overlay."""
    pitch, start = PitchTemplate.standard(), time.perf_counter()
    try:
        found = calibrate_without_clicks(pitch, picture, side="near")
    except InputError as refused:
        seconds = time.perf_counter() - start
        return Score(False, np.zeros(len(PIXELS)), False, seconds, refused.found)
    seconds = time.perf_counter() - start
    if found.report.lines is not None:
        pitch = pitch.with_surface(found.report.lines.estimate.surface)
    camera = found.estimate.camera
    either = [compare(each, pitch, still) for each in (camera, turn_camera(camera))]
    shares, bad = max(either, key=lambda each: float(each[0].sum()))
    if out is not None:
        _draw(picture, camera, pitch, still, out)
    return Score(True, shares, bool(shares[-1] < 0.5), seconds, ", ".join(bad))


def _draw(
    picture: Image, camera: Camera, pitch: PitchTemplate, still: Mapping[str, Any], out: Path
) -> None:
    """Write an overlay: projections red, labels yellow."""
    drawn = np.ascontiguousarray(picture[..., ::-1])
    for line in project_markings(camera, pitch).values():
        for x, y in line[np.isfinite(line).all(axis=1)].round().astype(int).tolist():
            cv2.circle(drawn, (x, y), 1, (0, 0, 255), -1)
    for pixels in still["markings"].values():
        for x, y in np.array(pixels).round().astype(int).tolist():
            cv2.circle(drawn, (x, y), 3, (0, 255, 255), 1)
    out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out / f"{still['name']}.png"), drawn)


def summarize(title: str, scores: Sequence[Score]) -> None:
    """Print the shares of some stills."""
    if not scores:
        return
    accepted = [each for each in scores if each.accepted]
    over = [np.mean([each.jaccard for each in group], axis=0) for group in (accepted, scores)]
    print(
        f"{title}: {len(scores)} stills, {len(accepted) / len(scores):.1%} calibrated, "
        f"{sum(each.wrong for each in scores)} wrong"
    )
    for group, shares in zip(("of these", "of all"), over, strict=True):
        print(
            f"  JaC@5 / @10 / @20 {group}: {' / '.join(f'{100.0 * each:.1f}' for each in shares)}"
        )
    print(f"  {np.median([each.seconds for each in scores]):.1f} s per still (median)")


def score(data: Path, options: argparse.Namespace) -> None:
    """Print one line per still, and the summary."""
    scores: dict[str, list[Score]] = {"tuned": [], "held": []}
    for still in read_labels(options.half, options.only or ()):
        picture = cv2.imread(str(data / "still_cameras" / f"{still['name']}.png"))
        if picture is None:
            raise SystemExit(f"expected {still['name']}.png in {data}: run fetch")
        rgb = np.asarray(np.ascontiguousarray(picture[..., ::-1]), np.uint8)
        each = score_still(rgb, still, options.out)
        scores[still["half"]].append(each)
        state = "calibrated" if each.accepted else "refused"
        state = "WRONG" if each.wrong else state
        shares = " ".join(f"{share:.2f}" for share in each.jaccard)
        print(f"{still['name']}: {state} {shares}, {each.seconds:.1f} s, {each.reason}", flush=True)
    for half, listed in scores.items():
        summarize(half, listed)
    summarize("all", [*scores["tuned"], *scores["held"]])
    cameras = {still["camera"] for still in read_labels(options.half, options.only or ())}
    print(f"{len(cameras)} cameras")


def main() -> None:
    """Run one of the two commands."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=("fetch", "score"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--mirror", type=Path)
    parser.add_argument("--half", choices=("tuned", "held"))
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.command == "fetch":
        fetch(options.data, options.mirror)
    else:
        score(options.data, options)


if __name__ == "__main__":
    main()
