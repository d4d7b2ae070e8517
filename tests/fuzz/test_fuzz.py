"""A sample of the fuzzer, and that it finds defects."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fuzz import judging
from fuzz.cases import base_of, build, draw_case, parse_case, run_case
from fuzz.judging import failure_class, forked
from fuzz.kinds import KINDS
from worldpose.errors import InputError, InternalError
from worldpose.store.store import Store


@pytest.mark.slow
def test_a_sample_of_cases_ends_without_a_defect(tmp_path):
    """Longer: python -m tests.fuzz --cases 5000 --seed S --out DIR."""
    command = [sys.executable, "-m", "tests.fuzz", "--seed", "1", "--cases", "48"]
    command += ["--out", str(tmp_path)]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stdout + done.stderr
    outcomes = [json.loads(line) for line in (tmp_path / "cases.jsonl").read_text().splitlines()]
    assert len(outcomes) == 48
    assert {"right", "refused"} <= {outcome["class"] for outcome in outcomes}
    assert "harmless right" in done.stdout


@pytest.mark.parametrize(
    ("error", "called"),
    [
        (InputError("a: b", expected="c", found="d", todo="Do e."), "refused"),
        (InputError("a: b", expected="c", found="", todo="Do e."), "message"),
        (InputError("a: array b", expected="c", found="nan", todo="E"), "contract"),
        (InternalError("tracking/clip", "expected a, found b"), "internal"),
        (KeyError("click"), "traceback"),
        (FileNotFoundError(2, "No such file", "x.json"), "refused"),
    ],
)
def test_exceptions_have_their_class(error, called):
    assert failure_class(error)[0] == called


def lose_a_key(store, folder):
    raise KeyError("cameras")


def leave_a_file(store, folder):
    staged = Path(store.url) / "staging" / "dead"
    staged.mkdir(parents=True)
    (staged / "x").touch()
    raise InputError("match.yaml: fps", expected="a rate", found="none", todo="State it.")


def read_wrong_joints(store, match_id, stage, unit, key, *, of=Store.open_result):
    found = of(store, match_id, stage, unit, key)
    return found.assign(joints=found["joints"] + 0.3) if stage == "body_fitting" else found


@pytest.mark.parametrize(
    ("place", "defect", "called"),
    [
        ((judging, "register"), lose_a_key, "traceback"),
        ((judging, "register"), leave_a_file, "half-written"),
        ((Store, "open_result"), read_wrong_joints, "nonsense"),
    ],
)
def test_a_planted_defect_is_found(place, defect, called, monkeypatch):
    monkeypatch.setattr(*place, defect)
    monkeypatch.setattr(judging, "_open_results_once", lambda: None)
    assert forked(run_case, ["further_keys"], 5)["class"] == called
    assert forked(os.abort)["class"] == "crash"


def test_every_kind_finds_its_match_and_is_made_again_from_its_name():
    assert len(KINDS) >= 200
    assert all(base_of([name]) is not None for name in KINDS)
    names, seed = draw_case(3, 12)
    assert parse_case(f"{'+'.join(names)}:{seed}") == (names, seed)
    draft, twin = (build(["people_missed_at_times"], 5)[0] for _ in range(2))
    for name, camera in draft.cameras.items():
        np.testing.assert_array_equal(draft.seen[name]["keypoints"], twin.seen[name]["keypoints"])
        assert np.isfinite(camera.pixels(draft.people)).mean() > 0.9
