"""Many small units, and a finished match run again."""

import resource
import shutil
import time

import pytest
import yaml
from command_line import succeed

from flows.method import METHOD
from flows.registering import register
from flows.run_plan import plan_run
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.store import Store

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600), pytest.mark.usefixtures("server")]

CAMERAS = 5000
"""Each is two small units, of `ingest` and of `static_calibration`."""
WORKERS = 2
MOST_OVERHEAD = 0.01
"""Of a small unit, more than in a plain loop of the same functions [s of processor]."""


def test_ten_thousand_small_units_are_computed_and_found_again(tmp_path, capsys):
    folder, project = tmp_path / "many", tmp_path / "project"
    many_cameras(folder, CAMERAS)
    asked = ("run", folder, "--project", project, "--until", "static_calibration", "--json")
    own = {"PREFECT_API_URL": ""}  # a server of its own, whose time counts
    units, before = 2 * CAMERAS, processor_seconds()
    done = succeed(*asked, "--workers", WORKERS, timeout=3000, environment=own).json
    each = (processor_seconds() - before) / units
    assert (done["executed"], done["failed"]) == (units, 0)
    began = time.monotonic()
    again = succeed(*asked, timeout=600, environment=own).json
    seconds = time.monotonic() - began
    assert (again["executed"], again["run"]) == (0, done["run"])
    alone = seconds_in_a_loop(folder, tmp_path / "loop")
    with capsys.disabled():
        print(f"\n{units} units in {done['seconds']:.0f} s, again {seconds:.1f} s")
        print(f"of processor a unit: {1e3 * each:.1f} ms, in a plain loop {1e3 * alone:.1f} ms")
    assert seconds < 30.0
    assert each - alone <= MOST_OVERHEAD


def seconds_in_a_loop(folder, project):
    """Return the time per unit in one process that computes and publishes units in turn."""
    from flows.match import task_of  # late: Dask and Prefect take seconds to import

    store = Store.create(str(project))
    match, _ = register(store, folder)
    planned = plan_run(store, match, {}, METHOD[:2])
    tasks = {stage.name: task_of(stage).fn for stage in METHOD[:2]}
    some = [(tasks[each.recipe.stage], each.work(store.url, match, "0001")) for each in planned]
    for compute, work in some[:2] + some[-2:]:
        compute(work)  # loads what it needs
    some = some[2:-2:10]
    began = time.process_time()
    for compute, work in some:
        compute(work)
    return (time.process_time() - began) / len(some)


def processor_seconds():
    """Return the processor time of ended child processes, including their children."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def many_cameras(folder, count):
    """Write a match of `count` copies of one camera and its detections, at two places."""
    small = folder.with_name("small")
    options = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}
    simulate_match(SCENARIOS["tiny"], 0, small, MatchOptions(calibrated=True, **options))
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
    # Two places: no calibration has all cameras in one.
    cut = [text.index(f"[cam_{number}]") for number in range(3)]
    blocks = [text[cut[0] : cut[1]], text[cut[1] : cut[2]]]
    cameras = [
        blocks[n % 2].replace(f"cam0{n % 2}", name).replace(f"cam_{n % 2}", f"cam_{n}")
        for n, name in enumerate(names)
    ]
    (folder / "calibration.toml").write_text("".join(cameras))
    for name in names:
        shutil.copy(small / "detections" / "cam00.npz", folder / "detections" / f"{name}.npz")
