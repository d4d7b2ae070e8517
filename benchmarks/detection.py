"""Prints the cost of person detection on this computer, stage by stage.

    python benchmarks/detection.py [--people 25] [--frames 8]
    python benchmarks/detection.py --workers 1 4 [--device cuda] [--half]

A crowd of `--people` in images of 1920 x 1080 is rendered, encoded and decoded; the embedded
detector finds people in the images of a calibrated camera, and the embedded estimator finds the
pose of each. The same nets in floating point stand beside them. One thread; times are processor
time, so other work on the machine does not count. The last lines extrapolate the reconstruction's
share, without rendering, to 90 minutes at 50 frames per second of 16 cameras.

With `--workers`, that many processes at the same time take a video each through all of the stage:
decoding, boxes, tracks of boxes, and poses, on a CPU or on a GPU that they share. The images per
second are those of all processes, without the start and the first images.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import cycle, islice
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from data_contracts.arrays import Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.enlargement import SeesParts, expect_parts
from worldpose.detection.interfaces import People, PoseEstimator
from worldpose.detection.models import (
    BUNDLED_WEIGHTS,
    load_bundled_detector,
    load_bundled_pose,
    load_detectors,
    load_pose,
    load_score_map,
)
from worldpose.detection.pipeline import PeopleFinder, Place
from worldpose.detection.settings import DetectionSettings
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.cast import assign_roles, dress_people
from worldpose.simulation.crowd import gather
from worldpose.simulation.matches import open_view, render_frame
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.simulation.settings import RenderingSettings, RigSettings
from worldpose.video.files import write_video
from worldpose.video.folder import open_video

Result = TypeVar("Result")

_shared: list[Barrier] = []
"""In a process of a measurement: the barrier of all of them."""

FPS = 50.0
MATCH_FRAMES = 90 * 60 * 50 * 16
"""Images of a match: 90 minutes, 50 frames per second, 16 cameras."""
SURE = 0.4
"""Minimum score of boxes that get a pose here: the stage's high score threshold."""
VIDEO_FRAMES, FIRST_FRAMES = 192, 16
"""Frames of each worker's video, and those computed before the clock starts."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=25)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--workers", type=int, nargs="+", default=[])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--half", action="store_true")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    rendering, pictures, camera, pitch = render_crowd(asked.people, asked.frames)
    if asked.workers:
        settings = DetectionSettings(device=asked.device, half=asked.half)
        compare_workers(pictures, Place(camera, pitch), settings, asked.workers)
        return
    decoding = time_decoding(pictures)
    parts = expect_parts(camera, pitch, DetectionSettings().pitch_margin_m)
    rows = [("rendering", rendering), ("decoding", decoding)]
    people: list[People] = []
    for kind, weights in ((", float", BUNDLED_WEIGHTS), ("", (None, None))):
        detector = load_bundled_detector(weights[0])
        assert isinstance(detector, SeesParts)
        looking, found = time_work(partial(detector.detect_parts, pictures, parts))
        people = [People(p.boxes[p.scores >= SURE], p.scores[p.scores >= SURE]) for p in found]
        estimator = load_bundled_pose(weights[1])
        posing, _ = time_work(partial(find_poses, estimator, pictures, people))
        rows += [(f"boxes{kind}", looking), (f"poses{kind}", posing)]
    count = len(pictures)
    persons = sum(len(each.scores) for each in people)
    print(f"{'':24}{'ms per image':>14}{'images/s':>12}{'players/s':>12}")
    for name, seconds in rows:
        print(
            f"{name:24}{1e3 * seconds / count:14.1f}"
            f"{count / seconds:12.1f}{persons / seconds:12.0f}"
        )
    each = dict(rows)
    before = each["boxes, float"] + each["poses, float"]
    print(f"floating point / integers (default): {before / (looking + posing):.2f}")
    for stride in (1, 2, 5):
        cost = (decoding + looking / stride + posing) / count
        hours = cost * MATCH_FRAMES / 3600.0
        print(
            f"match, stride {stride}: {hours:.0f} core hours, {hours / 2:.0f} h on 2 cores, "
            f"{hours / 16:.1f} h on 16, at {persons / count:.1f} people per image"
        )


def compare_workers(
    pictures: list[Image], place: Place, settings: DetectionSettings, workers: list[int]
) -> None:
    """Print the images per second of numbers of processes that work at the same time."""
    whole = f"{settings.device}{', half precision' if settings.half else ''}"
    print(f"{whole:28}{'images/s':>10}{'ms per image':>14}{'people':>8}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "crowd.mp4"
        # Neighbouring frames are as in a video.
        there_and_back = [*pictures, *pictures[-2:0:-1]]
        write_video(path, list(islice(cycle(there_and_back), VIDEO_FRAMES)), FPS)
        for count in workers:
            context = multiprocessing.get_context("spawn")
            barrier = context.Barrier(count)
            with ProcessPoolExecutor(
                count, context, initializer=_share, initargs=(barrier,)
            ) as processes:
                each = [processes.submit(time_video, path, place, settings) for _ in range(count)]
                results = [one.result() for one in each]
            seconds = max(stop for _, stop, _ in results) - min(start for start, _, _ in results)
            rate = count * VIDEO_FRAMES / seconds
            people = sum(found for _, _, found in results) / (count * VIDEO_FRAMES)
            print(f"{count:3} processes{rate:25.1f}{1e3 / rate:14.1f}{people:8.1f}", flush=True)


def _share(barrier: Barrier) -> None:
    """Keep the barrier at which the processes of a measurement wait for each other."""
    _shared.append(barrier)


def time_video(path: Path, place: Place, settings: DetectionSettings) -> tuple[float, float, int]:
    """Return start and end [s since the epoch], and the people found, of detection in a video."""
    torch.set_num_threads(1)
    finder = PeopleFinder(
        load_detectors(settings), load_pose(settings), settings, load_score_map(settings)
    )

    def find(frames: int) -> int:
        with open_video(path) as video:
            found = list(finder.find(video.frames(0, frames), place))
        return sum(int(np.isfinite(chunk.score).sum()) for chunk in found)

    find(FIRST_FRAMES)
    _shared[0].wait()
    start = time.time()
    people = find(VIDEO_FRAMES)
    return start, time.time(), people


def find_poses(
    estimator: PoseEstimator, pictures: list[Image], people: list[People]
) -> list[KeypointDetections]:
    """Return the poses in each image."""
    return [
        estimator.estimate(picture, each.boxes)
        for picture, each in zip(pictures, people, strict=True)
    ]


def render_crowd(people: int, frames: int) -> tuple[float, list[Image], Camera, PitchTemplate]:
    """Return seconds of rendering, images of a moving crowd, and their camera and pitch."""
    scenario = SCENARIOS["match"]
    pitch = PitchTemplate.from_spec(scenario.pitch)
    crowd = gather(
        scenario.model_copy(update={"crowd": scenario.crowd.model_copy(update={"people": people})}),
        pitch,
        np.random.SeedSequence(5),
    )
    times = 1.0 + np.arange(frames) / FPS
    looks = RenderingSettings()
    poses, later = crowd.poses(times), crowd.poses(times + looks.exposure_s)
    cast = dress_people(
        poses.betas[:, 0], assign_roles(scenario.crowd, len(crowd.paths)), 5, looks.patterns
    )
    middle = np.median(crowd.joints(times[:1])[0, :, 11], axis=0)
    rig = RigSettings(person_height_px=60.0, image_size_px=(1920, 1080))
    camera = place_camera(rig, 3, middle, scenario.pitch, np.random.default_rng(5))
    view = open_view(camera, pitch, 5, looks)

    def film(frame: int) -> Image:
        moment = (cast.pose(poses[:, frame]), cast.pose(later[:, frame]))
        return render_frame(view, cast, *moment, frame=frame).image

    film(0)
    return *time_work(lambda: [film(frame) for frame in range(frames)]), camera, pitch


def time_decoding(pictures: list[Image]) -> float:
    """Return the seconds to decode as many images from a video."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pictures.mp4"
        write_video(path, pictures, FPS)
        with open_video(path) as video:
            seconds, _ = time_work(lambda: list(video.frames(0, len(pictures))))
    return seconds


def time_work(work: Callable[[], Result]) -> tuple[float, Result]:
    """Return processor seconds of some work, and its result."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


if __name__ == "__main__":
    main()
