"""A finished match of ninety minutes is found again at once."""

import shutil
import time

import pytest
import yaml
from command_line import succeed
from stand_ins import publish_stand_in

from flows.registering import register
from flows.run_plan import plan_run
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.store import Store

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

CLIPS = 90
"""Of a minute each."""
FRAMES = 3000
CAMERAS = 16
FILES = {
    "ingest": 21,
    "static_calibration": 30,
    "camera_consistency": 4,
    "tracking": 31,
    "triangulation": 300,
    "bundle_adjustment": 45,
    "retriangulation": 300,
    "body_fitting": 180,
    "broadcast_calibration": 100,
    "broadcast_pooling": 20,
    "refitting": 180,
    "filtering": 107,
}
"""Number of files per unit of one minute, as a run of `match` wrote them."""


def long_match(folder):
    """Write a match folder of CLIPS clips and CAMERAS cameras with almost no detections."""
    small = folder.with_name("small")
    seen = {"duration": 0.2, "cameras": CAMERAS, "players": 1}
    bare = {"calibrated": True, "stills": False, "video": False}
    simulate_match(SCENARIOS["match"], 0, small, MatchOptions(**seen, **bare))
    shutil.copytree(small, folder)
    spec = yaml.safe_load((small / "match.yaml").read_text())
    (clip,) = spec["clips"]
    spec["clips"] = [
        {
            **clip,
            "id": f"clip{number:02d}",
            "first_frame": number * FRAMES,
            "frame_count": FRAMES,
        }
        for number in range(CLIPS)
    ]
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    of_clip = folder / "detections" / "clip.npz"
    for clip in spec["clips"]:
        shutil.copy(of_clip, of_clip.with_name(f"{clip['id']}.npz"))
    of_clip.unlink()


def publish(store, match, unit):
    """The result of a planned unit, of as many files as it would have."""
    minutes = CLIPS if unit.recipe.stage == "ingest" and unit.recipe.unit.startswith("cam") else 1
    count = FILES[unit.recipe.stage] * minutes
    publish_stand_in(store, match, unit, [f"array{k % 10}/c/{k // 10}" for k in range(count)])
    return count


def test_a_finished_match_of_ninety_minutes_is_found_again_at_once(tmp_path, capsys):
    long_match(tmp_path / "long")
    store = Store.create(tmp_path / "project")
    match, _ = register(store, tmp_path / "long")
    planned = plan_run(store, match, {})
    files = sum(publish(store, match, unit) for unit in planned)
    assert files > 100_000
    asked = ("run", tmp_path / "long", "--project", tmp_path / "project", "--json")
    first = succeed(*asked).json  # its record is made
    assert (first["executed"], first["reused"], first["failed"]) == (0, len(planned), 0)
    began = time.monotonic()
    again = succeed(*asked).json
    seconds = time.monotonic() - began
    assert (again["executed"], again["reused"], again["run"]) == (0, len(planned), first["run"])
    with capsys.disabled():
        print(f"\n{len(planned)} units of {files} files: {seconds:.1f} s")
    assert seconds < 30.0
