"""Time and memory of detection, of whole runs and their units, and of data sets."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import timedelta
from functools import partial
from itertools import chain, starmap
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np
import psutil
import torch
from common import WORLDPOSE, tell
from registry import OUT, Table, Tables, benchmark, integer, option

from data_contracts.arrays import Image
from flows.results.dataset import check, count
from worldpose.body.body_file import OPEN_BODY, find_body
from worldpose.body.model import BodyParameters
from worldpose.detection.enlargement import SeesParts, expect_parts
from worldpose.detection.models import (
    BUNDLED_WEIGHTS,
    load_bundled_detector,
    load_bundled_pose,
    load_detectors,
    load_pose,
)
from worldpose.detection.pipeline import PeopleFinder, Place
from worldpose.detection.settings import DetectionSettings
from worldpose.formats.joints_file import write_poses
from worldpose.formats.release_cameras import write_moving_camera
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.match_folder import read_match
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.crowd import gather
from worldpose.simulation.mannequins import assign_roles, dress_people
from worldpose.simulation.renderer import Moment, open_view
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.simulation.settings import RenderingSettings, RigSettings
from worldpose.store.store import Store
from worldpose.video.files import write_video
from worldpose.video.folder import open_video

RUN = Path(__file__).with_name("run.py")
Result = TypeVar("Result")

FPS = 50.0

MATCH_FRAMES = 90 * 60 * 50 * 16
"""Images of a match: 90 minutes, 50 frames per second, 16 cameras."""

SURE = 0.4
"""Minimum score of boxes that get a pose here: the stage's high score threshold."""

INTERVAL_S = 0.25


@benchmark(
    "detection",
    "cost of person detection and poses, in integers and in floating point",
    integer("people", 25),
    integer("frames", 8),
    integer("rounds", 5),
)
def measure_detection(options: Namespace) -> Tables:
    """A crowd in images of 1920 x 1080 is rendered, decoded, searched and posed, in one thread.

    Times are processor time, so other work on the machine does not count. The second table
    extrapolates to 90 minutes at 50 frames per second of 16 cameras, without rendering. The last
    one is of the stage without video: its nets answer with what they returned the first time, so
    that the time is that of the work between them.
    """
    torch.set_num_threads(1)
    rendering, pictures, camera, pitch = render_crowd(options.people, options.frames)
    decoding = time_decoding(pictures)
    parts = expect_parts(camera, pitch, DetectionSettings().pitch_margin_m)
    work, persons = {"rendering": rendering, "decoding": decoding}, 0
    for kind, weights in ((", float", BUNDLED_WEIGHTS), ("", (None, None))):
        detector = load_bundled_detector(weights[0])
        assert isinstance(detector, SeesParts)
        looking, found = time_work(partial(detector.detect_parts, pictures, parts))
        people = [p.select(p.scores >= SURE) for p in found]
        pose = load_bundled_pose(weights[1])
        pairs = list(zip(pictures, (each.boxes for each in people), strict=True))
        posing, _ = time_work(partial(list, starmap(pose.estimate, pairs)))
        work |= {f"boxes{kind}": looking, f"poses{kind}": posing}
        persons = sum(len(each.scores) for each in people)
    number, whole = len(pictures), looking + posing
    before = work["boxes, float"] + work["poses, float"]
    rows = [
        [name, 1e3 * each / number, number / each, persons / each] for name, each in work.items()
    ]
    match = []
    for stride in (1, 2, 5):
        hours = (decoding + looking / stride + posing) / number * MATCH_FRAMES / 3600.0
        match.append([stride, hours, hours / 2, hours / 16])
    title = f"{persons / number:.1f} people per image; floating point over integers "
    names = ["stride", "core hours", "hours on 2 cores", "hours on 16 cores"]
    return {
        "work": Table(
            f"{title}{before / whole:.2f}", ["work", "ms/image", "images/s", "people/s"], rows
        ),
        "match": Table("a match", names, match),
        "between": time_between(pictures, Place(camera, pitch), options.rounds),
    }


class Recorded:
    """A session of a net that gives its first outputs again, in the order of the calls."""

    def __init__(self, session: Any) -> None:
        self._session, self._outputs = session, list[Any]()
        self.call = 0

    def run(self, names: Any, inputs: Any) -> Any:
        """Return the outputs of the call of this number."""
        if self.call == len(self._outputs):
            self._outputs.append(self._session.run(names, inputs))
        self.call += 1
        return self._outputs[self.call - 1]


def time_between(pictures: list[Image], place: Place, rounds: int) -> Table:
    """Return the time of the work between the nets, and the memory before and after many rounds."""
    settings = DetectionSettings()
    nets: list[Any] = [*load_detectors(settings), load_pose(settings)]
    finder = PeopleFinder(nets[:-1], nets[-1], settings)
    whole, memory, process = 0.0, list[float](), psutil.Process()
    with ExitStack() as patches:
        recorded = [Recorded(each._net._net._session) for each in nets]
        for each, session in zip(nets, recorded, strict=True):
            patches.enter_context(patch.object(each._net._net, "_session", session))
        for number in range(rounds + 2):
            for session in recorded:
                session.call = 0
            memory.append(process.memory_info().rss / 2**20)
            seconds, _ = time_work(lambda: list(finder.find(enumerate(pictures), place)))
            whole += seconds if number > 1 else 0.0  # recorded and warm
    images = rounds * len(pictures)
    title = (
        f"between the nets; {memory[2]:.0f} MB before {images} images, {memory[-1]:.0f} MB after"
    )
    return Table(title, ["part", "ms/image"], [["together", 1e3 * whole / images]])


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
        return view.expose(Moment(cast, *moment), frame).image

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


@benchmark(
    "run_memory",
    "time and peak memory of each stage of whole runs, and their growth with the duration",
    option("matches", type=Path, nargs="+", help="match folders of different durations"),
    option("--to", type=float, default=5400.0, help="duration to extrapolate to [s]"),
    OUT,
)
def measure_runs(options: Namespace) -> Tables:
    """`worldpose simulate --scenario match --duration 60 --no-stills --no-video --out m60`.

    Every match runs as `worldpose run` in a new project, and the resident memory of all its
    processes is read from /proc four times per second. A stage's peak is that of the largest
    process while its units are computed; `all` is the largest sum over all processes. With several
    matches a straight line through the shortest and the longest one is extrapolated.
    """
    runs: list[tuple[float, dict[str, Cost]]] = []
    with tempfile.TemporaryDirectory() as temporary:
        parent = options.out or Path(temporary)
        parent.mkdir(parents=True, exist_ok=True)
        for folder in options.matches:
            spec = read_match(folder).spec
            length = sum(clip.frame_count for clip in spec.clips) / spec.fps
            tell(f"{folder.name}: {length:g} s of match")
            runs.append((length, measure_run(folder, parent / folder.name)))
    runs.sort(key=lambda run: run[0])
    columns = [f"{length:g} s: {what}" for length, _ in runs for what in ("time [s]", "peak [MB]")]
    share = 0.0
    if len(runs) > 1:
        columns += [f"{options.to:g} s: {what}" for what in ("time [s]", "peak [MB]")]
        share = (options.to - runs[0][0]) / (runs[-1][0] - runs[0][0])
    rows = []
    for stage in runs[-1][1]:
        costs = [run.get(stage, (0.0, 0, 0)) for _, run in runs]
        cells = [(cost[0], cost[2 if stage == "all" else 1] / 1e6) for cost in costs]
        if share:
            ends = zip(cells[0], cells[-1], strict=True)
            cells.append(tuple(a + share * (b - a) for a, b in ends))  # type: ignore[arg-type]
        rows.append([stage, *chain.from_iterable(cells)])
    return {"stages": Table("whole runs", ["stage", *columns], rows)}


Cost = tuple[float, int, int]
"""Time from the start of the first to the end of the last unit [s], peak of the largest process and
of all together [byte]."""


def stage_spans(project: Path, folder: Path) -> dict[str, tuple[float, float]]:
    """Return start of the first and end of the last unit of each stage of the latest run [s]."""
    store = Store.open(str(project))
    record = store.run(read_match(folder).spec.match_id, "latest")
    spans: dict[str, tuple[float, float]] = {}
    for name in record.executed:
        stage, _, unit = name.partition("/")
        manifest = store.manifest(record.match_id, stage, unit, record.results[name])
        last = manifest.created_at.timestamp()
        first = (manifest.created_at - timedelta(seconds=manifest.seconds)).timestamp()
        known = spans.get(stage, (first, last))
        spans[stage] = min(first, known[0]), max(last, known[1])
    return spans


def measure_run(folder: Path, project: Path) -> dict[str, Cost]:
    """Run a match in a new project and return the cost of its stages and of `all`."""
    command = [str(WORLDPOSE), "run", str(folder), "--project", str(project)]
    begin, samples = time.time(), list[tuple[float, int, int]]()
    with (project.parent / f"{project.name}.log").open("w") as log:
        process = psutil.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        while process.poll() is None:
            with suppress(psutil.Error):  # a process ended meanwhile
                family = [process, *process.children(recursive=True)]
                sizes = [each.memory_info().rss for each in family]
                samples.append((time.time(), max(sizes), sum(sizes)))
            time.sleep(INTERVAL_S)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}: see {log.name}")
    spans = sorted(stage_spans(project, folder).items(), key=lambda item: item[1])
    costs = {}
    for stage, (first, last) in [*spans, ("all", (begin, time.time()))]:
        inside = [each[1:] for each in samples if first <= each[0] <= last + INTERVAL_S]
        largest, total = np.max([(0, 0), *inside], axis=0).tolist()
        costs[stage] = (last - first, largest, total)
    return costs


STEPS = ("write", "check", "count")


@benchmark(
    "data_set_size",
    "time and peak memory of writing, checking and counting a data set",
    option("folder", type=Path),
    integer("clips", 88),
    integer("frames", 1694, "of each clip"),
    integer("people", 17),
    option("--step", choices=STEPS, help="this step alone, in this process"),
)
def measure_data_set(options: Namespace) -> Tables:
    """The defaults give 2.53 million poses, the size of the paper's data set.

    People run straight on before a panning, zooming camera. Each step runs in a separate process,
    to measure its own peak.
    """
    rows = []
    if options.step is None:
        for step in STEPS:
            words = [str(options.folder), "--step", step, "--json", f"{options.folder}-{step}.json"]
            words += [f"--{n}={getattr(options, n)}" for n in ("clips", "frames", "people")]
            command = [sys.executable, str(RUN), "data_set_size", *words]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            rows += json.loads(Path(words[4]).read_text())["tables"]["steps"]["rows"]
    else:
        base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        begin = time.perf_counter()
        if options.step == "write":
            for clip in range(options.clips):
                write_clip(options.folder, clip, options.frames, options.people)
        found: Any = None
        if options.step == "check":
            found = len(check(options.folder).findings)
        elif options.step == "count":
            found = count([options.folder]).poses
        peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) / 1024
        rows.append([options.step, time.perf_counter() - begin, peak, found])
    columns = ["step", "time [s]", "peak above the start [MB]", "findings or poses"]
    return {"steps": Table("a data set", columns, rows)}


def write_clip(folder: Path, clip: int, frames: int, people: int) -> None:
    """Write the poses and the camera of one clip."""
    model, rng = find_body(OPEN_BODY), np.random.default_rng(clip)
    time_s = np.arange(frames) / FPS
    start, way = rng.normal(0.0, 15.0, (people, 1, 2)), rng.normal(0.0, 2.0, (people, 1, 2))
    place = start + way * time_s[:, None]
    height = np.full((people, frames, 1), 0.95)  # of a standing body's pelvis [m]
    transl = np.concatenate([place, height], axis=-1) - model.joint_template[0]
    pose = 0.1 * rng.standard_normal((people, frames, 23, 3))
    orient = np.tile([np.pi / 2, 0.0, 0.0], (people, frames, 1))
    bodies = BodyParameters(np.zeros(10), orient, pose.reshape(people, frames, 69), transl)
    write_poses(folder / "poses" / f"C_{clip:03d}.npz", bodies, model.name)
    down = Rigid.from_rotvec([np.pi / 2 + np.arctan2(14.0, 70.0), 0.0, 0.0], np.zeros(3))
    pan = np.zeros((frames, 3))
    pan[:, 2] = 0.15 * np.sin(0.2 * time_s)
    turn = down.rotation @ Rigid.from_rotvec(pan, np.zeros(3)).rotation
    camera = Camera(
        focal=np.repeat(2200.0 + 200.0 * np.sin(0.1 * time_s)[:, None], 2, axis=1),
        principal_point=np.tile([960.0, 540.0], (frames, 1)),
        distortion=np.zeros((frames, 5)),
        cam_from_world=Rigid(turn, -turn @ np.array([0.0, -70.0, 14.0])),
        image_size=np.array([1920, 1080]),
    )
    write_moving_camera(folder / "cameras" / f"C_{clip:03d}.npz", camera)
