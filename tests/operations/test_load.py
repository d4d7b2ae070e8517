"""Many matches at once, many small units, and a finished match begun again."""

import shutil
import subprocess
import threading
import time

import psutil
import pytest
import yaml
from command_line import WORLDPOSE, succeed

from worldpose.store import Store
from worldpose.synthetic import SCENARIOS, simulate_match

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600), pytest.mark.usefixtures("server")]

MATCHES = 10
CAMERAS = 250
"""Each is two units, of `ingest` and of `static_calibration`."""


class Memory:
    """The most memory that any worker below some processes had while this was the context [MB]."""

    def __init__(self, pids):
        self.pids, self.most, self.is_over = pids, 0.0, threading.Event()

    def __enter__(self):
        self.thread = threading.Thread(target=self.look)
        self.thread.start()
        return self

    def __exit__(self, *error):
        self.is_over.set()
        self.thread.join()

    def look(self):
        while not self.is_over.wait(0.5):
            for pid in self.pids:
                for each in psutil.Process(pid).children(recursive=True):
                    self.most = max(self.most, each.memory_info().rss / 1e6)


def test_ten_matches_at_once_take_no_more_memory_and_hardly_more_time(dask, tmp_path, capsys):
    address, workers = dask
    folders = [tmp_path / f"match-{number}" for number in range(MATCHES)]
    for number, folder in enumerate(folders):
        small = {"duration": 0.2, "cameras": 3, "players": 2}
        bare = {"calibrated": True, "stills": False, "video": False}
        simulate_match(SCENARIOS["tiny"], number, folder, **small, **bare)

    def command(folder, project):
        return ["run", str(folder), "--project", str(project), "--dask", address]

    succeed(*command(folders[0], tmp_path / "first"))  # workers load what they need
    began = time.monotonic()
    with Memory(workers) as one_by_one:
        for folder in folders:
            succeed(*command(folder, tmp_path / "one-by-one"))
    sequential = time.monotonic() - began
    began = time.monotonic()
    with Memory(workers) as together:
        running = [
            subprocess.Popen(
                [*WORLDPOSE, *command(folder, tmp_path / "together")],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            for folder in folders
        ]
        assert [process.wait() for process in running] == [0] * MATCHES
    at_once = time.monotonic() - began
    with capsys.disabled():
        print(f"\n{sequential:.0f} s one by one, {at_once:.0f} s at once;", end=" ")
        print(f"{one_by_one.most:.0f} and {together.most:.0f} MB a worker")
    assert together.most <= 1.1 * one_by_one.most
    assert at_once <= sequential / 0.9


def test_many_small_units_are_computed_and_found_again(tmp_path, capsys):
    folder = tmp_path / "many"
    many_cameras(folder, CAMERAS)
    asked = ("run", folder, "--project", tmp_path / "project", "--until", "static_calibration")
    done = succeed(*asked, "--json", timeout=3000).json
    assert (done["executed"], done["failed"]) == (2 * CAMERAS, 0)
    began = time.monotonic()
    again = succeed(*asked, "--json", timeout=600).json
    seconds = time.monotonic() - began
    assert (again["executed"], again["run"]) == (0, done["run"])
    record = Store.open(str(tmp_path / "project")).run(f"many-{CAMERAS}")
    assert len(record.results) == 2 * CAMERAS
    with capsys.disabled():
        units = 2 * CAMERAS
        print(f"\n{units} units: {done['seconds']:.0f} s; again {seconds:.1f} s")
    assert seconds < 30.0


def many_cameras(folder, count):
    """A match of so many cameras, all of which saw and are what one of a small match did and is."""
    small = folder.with_name("small")
    options = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}
    simulate_match(SCENARIOS["tiny"], 0, small, calibrated=True, **options)
    names = [f"c{number:05d}" for number in range(count)]
    spec = yaml.safe_load((small / "match.yaml").read_text())
    (clip,) = spec["clips"]
    spec |= {
        "match_id": f"many-{count}",
        "cameras": [{**spec["cameras"][0], "id": name} for name in names],
        "clips": [{key: value for key, value in clip.items() if "broadcast" not in key}],
    }
    (folder / "detections").mkdir(parents=True)
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    shutil.copy(small / "pitch.json", folder)
    text = (small / "calibration.toml").read_text()
    block = text[text.index("[cam_0]") : text.index("[cam_1]")]
    cameras = [
        block.replace("cam00", name).replace("cam_0", f"cam_{number}")
        for number, name in enumerate(names)
    ]
    (folder / "calibration.toml").write_text("".join(cameras))
    for name in names:
        shutil.copy(small / "detections" / "cam00.npz", folder / "detections" / f"{name}.npz")
