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
from worldpose.errors import InputError, InternalError

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("cases", [20, pytest.param(48, marks=pytest.mark.slow)])
def test_a_sample_of_cases_ends_without_a_defect(tmp_path, cases):
    """Longer: python -m tests.fuzz --cases 5000 --seed S --out DIR."""
    command = [sys.executable, "-m", "tests.fuzz", "--seed", "1", "--cases", str(cases)]
    command += ["--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stdout + done.stderr
    outcomes = [json.loads(line) for line in (tmp_path / "cases.jsonl").read_text().splitlines()]
    assert len(outcomes) == cases
    assert {"right", "refused"} <= {outcome["class"] for outcome in outcomes}
    assert "harmless right" in done.stdout


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


def test_every_kind_finds_its_match_and_is_made_again_from_its_name():
    assert len(KINDS) >= 200
    assert all(base_of([name]) is not None for name in KINDS)
    names, seed = draw_case(3, 12)
    assert parse_case(f"{'+'.join(names)}:{seed}") == (names, seed)
    draft, twin = (build(["people_missed_at_times"], 5)[0] for _ in range(2))
    for name, camera in draft.cameras.items():
        np.testing.assert_array_equal(draft.seen[name]["keypoints"], twin.seen[name]["keypoints"])
        assert np.isfinite(camera.pixels(draft.people)).mean() > 0.9
