"""A sample of the fuzzer, and what its own parts promise."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fuzz.cases import base_of, build, draw_case, parse_case
from fuzz.judging import failure_class, forked
from fuzz.kinds import KINDS
from fuzz.scene import film, new_draft, walking
from worldpose.errors import InputError, InternalError

ROOT = Path(__file__).parents[2]
SAMPLE = {"cases": 48, "seed": 1}


def test_a_sample_of_cases_ends_without_a_defect(tmp_path):
    """Longer: python -m tests.fuzz --cases 5000 --seed S --out DIR."""
    command = [sys.executable, "-m", "tests.fuzz", "--out", str(tmp_path)]
    command += [text for name, value in SAMPLE.items() for text in (f"--{name}", str(value))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stdout + done.stderr
    outcomes = [json.loads(line) for line in (tmp_path / "cases.jsonl").read_text().splitlines()]
    assert len(outcomes) == SAMPLE["cases"]
    assert {"right", "refused"} <= {outcome["class"] for outcome in outcomes}
    assert "harmless right" in (tmp_path / "report.txt").read_text()


def test_there_are_kinds_of_every_group_and_every_one_finds_its_match():
    assert len(KINDS) >= 200
    assert all(base_of([name]) is not None for name in KINDS)
    groups = {kind.group for kind in KINDS.values()}
    assert groups >= {"camera", "clicks", "people", "clips", "ids", "pitch", "toml", "bytes"}
    assert groups >= {"video", "store", "request", "settings"}


def test_a_case_is_made_again_from_its_name():
    names, seed = draw_case(3, 12)
    again = parse_case(f"{'+'.join(names)}:{seed}")
    assert again == (names, seed)
    draft, _, _ = build(["people_missed_at_times"], 5)
    twin, _, _ = build(["people_missed_at_times"], 5)
    for name in draft.seen:
        np.testing.assert_array_equal(draft.seen[name]["keypoints"], twin.seen[name]["keypoints"])


def test_sticks_walk_at_their_speed_and_keep_their_limbs():
    joints = walking((1.0, 2.0), 0.5, 1.75, np.arange(20) / 25, 0.3)
    moved = joints[-1].mean(axis=0) - joints[0].mean(axis=0)
    assert np.linalg.norm(moved[:2]) == pytest.approx(1.4 * 19 / 25, abs=0.08)
    shin = np.linalg.norm(joints[:, 13] - joints[:, 15], axis=-1)
    np.testing.assert_allclose(shin, 0.41, atol=1e-9)


def test_cameras_see_the_people_and_click_what_they_see():
    rng = np.random.default_rng(2)
    draft = new_draft(rng, True)
    film(draft, rng)
    for name, camera in draft.cameras.items():
        assert np.isfinite(camera.pixels(draft.people)).mean() > 0.9
        xy = np.array([point["xy"] for point in draft.clicks[name]["points"]])
        assert len(xy) >= 4
        assert (xy >= 0).all()
        assert (xy <= [camera.width, camera.height]).all()


@pytest.mark.parametrize(
    ("error", "called"),
    [
        (InputError("a: b", expected="c", found="d", todo="Do e."), "refused"),
        (InputError("a: b", expected="c", found="", todo="Do e."), "message"),
        (
            InputError("a: array b", expected="finite numbers only", found="nan", todo="E"),
            "contract",
        ),
        (InternalError("tracking/clip", "expected a, found b"), "internal"),
        (KeyError("click"), "traceback"),
        (FileNotFoundError(2, "No such file", "x.json"), "refused"),
    ],
)
def test_exceptions_have_their_class(error, called):
    assert failure_class(error)[0] == called


def test_a_process_that_dies_is_a_crash():
    assert forked(os.abort)["class"] == "crash"
    assert forked(lambda: {"class": "right"})["class"] == "right"
