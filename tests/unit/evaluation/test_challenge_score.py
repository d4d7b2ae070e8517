"""The challenge's score: numbers by hand, and no pose left out."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from flows.cli.app import app
from worldpose.errors import InputError
from worldpose.evaluation.challenge import ALL, score_submission
from worldpose.formats.challenge import write_submission


def submission(path, **clips):
    write_submission(path, clips)
    return path


def poses(persons=2, frames=3):
    return np.random.default_rng(0).normal(size=(persons, frames, 15, 3))


@pytest.mark.parametrize(
    ("joint", "whole", "local"),
    # A toe of 15 joints; a hip, which moves the mid-hip by half of it and with it every joint.
    [(14, 0.15 / 15, 0.15 / 15), (7, 0.15 / 15, 0.075), (slice(None), 0.15, 0.0)],
)
def test_the_score_is_the_global_error_and_five_times_the_local_one(tmp_path, joint, whole, local):
    true, found = poses(), poses()
    found[:, :, joint, 0] += 0.15
    truth = submission(tmp_path / "true.zip", one=true)
    mine = submission(tmp_path / "mine.zip", one=found)
    score = score_submission(mine, truth)["one"]
    np.testing.assert_allclose((score.global_m, score.local_m), (whole, local), atol=1e-6)
    assert score.poses == 6
    told = CliRunner().invoke(
        app, ["evaluate", "--prediction", str(mine), "--reference", str(truth), "--json"]
    )
    assert json.loads(told.stdout)["challenge_score"] == pytest.approx(whole + 5 * local, abs=1e-5)


def test_clips_count_by_their_joints_and_absent_people_do_not_count(tmp_path):
    true = {"a": poses(1, 1), "b": poses(1, 3)}
    found = {clip: array + (clip == "b") * np.array([0.4, 0, 0]) for clip, array in true.items()}
    true["b"][0, 2] = np.nan
    scores = score_submission(
        submission(tmp_path / "p.zip", **found), submission(tmp_path / "t.zip", **true)
    )
    assert scores[ALL].poses == 3
    assert scores[ALL].global_m == pytest.approx(2 * 0.4 / 3, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda p: {"one": p[:1]}, "persons, frames, 15, 3"),
        (lambda p: {"two": p}, "no such clip"),
        (lambda p: {"one": np.where(np.arange(3)[:, None, None] == 1, np.nan, p)}, "frame 1"),
    ],
)
def test_a_missing_clip_person_or_pose_is_refused(tmp_path, change, told):
    truth = submission(tmp_path / "t.zip", one=poses())
    with pytest.raises(InputError, match=told):
        score_submission(submission(tmp_path / "p.zip", **change(poses())), truth)


def test_a_table_without_its_last_empty_rows_is_scored_and_a_lacking_pose_is_refused(tmp_path):
    pytest.importorskip("pyarrow")
    true, found = poses(), poses() + [0.1, 0.0, 0.0]
    true[1], true[:, 2] = np.nan, np.nan
    truth = submission(tmp_path / "true.parquet", one=true)
    score = score_submission(submission(tmp_path / "mine.zip", one=found), truth)["one"]
    assert (score.global_m, score.poses) == (pytest.approx(0.1), 2)
    short = submission(tmp_path / "short.parquet", one=found[:, :1])
    with pytest.raises(InputError, match=r"1 without one|15 without one"):
        score_submission(short, truth)
