"""`worldpose evaluate` on files alone: what is scored, and what is said when nothing can be."""

import numpy as np
import pytest
from command_line import succeed

from worldpose.formats.joints_file import JointTracks
from worldpose.formats.motion_capture import write_markers


def changed(source, target, **changes):
    """A copy of an npz file with some arrays replaced by a function of themselves."""
    with np.load(source) as stored:
        arrays = dict(stored)
    for name, change in changes.items():
        arrays[name] = change(arrays[name])
    np.savez(target, **arrays)


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


def test_cameras_are_scored_against_those_of_the_reference(tiny, tmp_path):
    cameras = tmp_path / "cameras"
    cameras.mkdir()
    for file in (tiny / "reference" / "cameras").iterdir():
        # t = -R C: a shift of the centre by 0.3 m along x is -0.3 times the first column of R.
        with np.load(file) as stored:
            shift = -0.3 * stored["R"][:, :, 0]
        changed(file, cameras / file.name, t=lambda t, shift=shift: t + shift)
    figures = evaluate(tmp_path, tiny / "reference")
    assert set(figures) == {"cameras"}
    assert set(figures["cameras"]) == {"static", "broadcast"}
    errors = figures["cameras"]["static"]
    assert errors["center_error_m"] == pytest.approx(0.3, abs=1e-9)
    # Every pixel's ray is shifted alike; the crown bends that by less than a centimetre.
    assert errors["ground_error_median_m"] == pytest.approx(0.3, abs=0.01)
    assert errors["rotation_error_deg"] == pytest.approx(0.0, abs=1e-9)
    assert errors["focal_error_percent"] == 0


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
