"""Evaluation on files alone, and the paper's ablation."""

import shutil

import numpy as np
import pytest
from command_line import succeed

from flows.results.ablation import CLICKS, trial
from flows.results.evaluation import score
from worldpose.errors import InputError
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.motion_capture import write_markers
from worldpose.formats.release_cameras import read_camera


def changed(source, target, **changes):
    """A copy of an npz file with some arrays replaced by a function of themselves."""
    arrays = dict(np.load(source))
    np.savez(target, **arrays | {name: change(arrays[name]) for name, change in changes.items()})


def evaluate(prediction, reference, *options):
    return succeed(
        "evaluate", "--prediction", prediction, "--reference", reference, "--json", *options
    ).json


def test_truth_in_a_world_of_its_own_has_no_error_once_aligned(tiny, tmp_path):
    truth = tiny / "reference" / "joints.npz"
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    # As from a camera's own world: turned, ten metres away, four times too small.
    foreign = tmp_path / "joints.npz"
    changed(truth, foreign, joints=lambda joints: 0.25 * joints @ turn.T + [10.0, 0.0, 2.0])
    figures = evaluate(foreign, truth)
    for name in ("g_mpjpe_mm", "per_person_g_mpjpe_mm", "pa_mpjpe_mm", "per_meter_drift_cm_per_m"):
        assert figures[name] == pytest.approx(0.0, abs=1e-6)
    assert figures["g_scale"] == pytest.approx(4.0, abs=1e-9)
    assert figures["g_mpjpe_rigid_mm"] > 1000
    assert figures["challenge_score"] > 1
    assert "mpjpe_mm" not in figures
    # The frame rate is that of the match beside the reference.
    assert figures["switches_per_minute"] == 0
    assert "cameras" not in figures


def test_cameras_without_a_match_have_the_image_that_their_centre_states(tiny, tmp_path):
    def halved(k):
        return k * [[[0.5], [0.5], [1.0]]]

    for name in ("mine", "true"):
        (tmp_path / name / "cameras").mkdir(parents=True)
        for file in (tiny / "reference" / "cameras").iterdir():
            changed(file, tmp_path / name / "cameras" / file.name, K=halved)
    file = next((tmp_path / "true" / "cameras").iterdir())
    assert read_camera(file).image_size == pytest.approx([960, 540], abs=30)
    figures = evaluate(tmp_path / "mine", tmp_path / "true")
    assert figures["notes"] == [
        "no match states the pitch: ground errors are those of one of 105 x 68 m"
    ]


def test_joints_of_other_rates_are_refused(tiny, tmp_path):
    (tmp_path / "frame_rates.json").write_text('{"clip": 99.0}')
    shutil.copy(tiny / "reference" / "joints.npz", tmp_path)
    with pytest.raises(InputError, match=r"found 99 in .*joints\.npz and 25 in"):
        score(f"{tmp_path / 'joints.npz'}", f"{tiny / 'reference' / 'joints.npz'}", "none")


def test_markers_are_laid_over_and_scored(tiny, tmp_path):
    with np.load(tiny / "reference" / "joints.npz") as stored:
        tracks = JointTracks(stored["frames"], stored["person_ids"], stored["joints"])
    seen = np.isfinite(tracks.joints).all((0, 2, 3))
    # One person's markers, from 6 frames later on, and so on a clock that is early.
    later = JointTracks(tracks.frames[6:] - 6, tracks.person_ids, tracks.joints[6:])
    write_markers(tmp_path / "a.trc", later, int(np.flatnonzero(seen)[0]), 25.0)
    figures = evaluate(tiny / "reference" / "joints.npz", tmp_path / "a.trc", "--fps", "25")
    assert figures["reference_offset_s"] == pytest.approx(-6 / 25, abs=1e-3)
    # Micrometres in the file; the offset is found to a tenth of a millisecond.
    assert figures["mpjpe_mm"] == pytest.approx(0.0, abs=1.0)
    assert figures["persons"] == 1


@pytest.mark.slow
def test_people_and_markings_win_and_markings_alone_are_refused():
    scores = trial(2, CLICKS["few clicks"])
    true, both = scores["true cameras"], scores["+ BA, S and P"]
    base, free = scores["base"], scores["+ BA, S, unguarded"]
    assert both.g_mpjpe_mm < 1.02 * true.g_mpjpe_mm
    assert both.ground_error_m < 0.5 * base.ground_error_m
    # Lines fit better and people worse, as the paper warns; the held-out validation detects this.
    assert free.marking_error_px < 0.7 * base.marking_error_px
    assert free.g_mpjpe_mm > 1.1 * base.g_mpjpe_mm
    assert scores["+ BA, S only"].changed < 0.2
