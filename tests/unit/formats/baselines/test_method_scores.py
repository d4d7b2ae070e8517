"""Results in each method's layout, with a known error, give the row that this error is."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from method_files import FIRST, FRAMES, STEP, WALK, WRITERS, scene, truth_of, wobbled

from flows.cli.evaluate import named_rates
from flows.results.baselines import score_methods, table_csv, table_latex, table_rows
from worldpose.body.model import BodyParameters
from worldpose.dataset.manifest import write_frame_rates
from worldpose.errors import InputError, UsageError
from worldpose.formats.baselines import METHODS
from worldpose.formats.joints_file import write_joints
from worldpose.formats.release_cameras import write_moving_camera

LOCAL, ALONE = ("hybrik", "4dhumans"), ("wham", "gvhmr")
NOT_SEEN = "smpl"
"""Its file says nothing about the image: it is matched by its paths."""


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    bodies, camera = scene()
    write_joints(folder / "joints.npz", truth_of(bodies))
    write_moving_camera(folder / "cameras" / "clip.npz", camera)
    return folder


def scored(name, path, truth, match_in="clip"):
    match_in = None if name == NOT_SEEN else match_in
    return score_methods([f"{name}={path}"], str(truth), match_in=match_in)[0]


@pytest.mark.parametrize("name", METHODS)
def test_known_error_gives_the_known_row(name, truth, tmp_path):
    bodies, camera = scene()
    score = scored(name, WRITERS[name](tmp_path, wobbled(bodies), camera), truth)
    found = score.evaluation
    assert (score.method, score.first_frame, found.track_coverage) == (name, FIRST, 1.0)
    # Files hold single precision: at 70 m from the camera a few micrometres.
    assert found.pa_mpjpe_mm == pytest.approx(0.0, abs=0.05)
    # Everybody is 1 cm too high or too low. Scale takes up s - 1 = STEP^2 / variance of the
    # places, 5.3 m^2 and more: at 4 m from the middle 0.08 mm.
    whole, path = 1000.0 * STEP, 100.0 * STEP / WALK
    if name in LOCAL:
        assert found.per_person_g_mpjpe_mm is None
    else:
        assert found.per_person_g_mpjpe_mm == pytest.approx(whole, abs=0.1)
        # The path is the mid-hip's, which sways a little about the straight line.
        assert found.per_person_drift_cm_per_m == pytest.approx(path, rel=0.1)
    if name in (*LOCAL, *ALONE):
        assert found.g_mpjpe_mm is None
        assert found.mpjpe_mm is None
    else:
        assert found.g_mpjpe_mm == pytest.approx(whole, abs=0.1)
        assert found.per_meter_drift_cm_per_m == pytest.approx(path, rel=0.1)
        # Alone or not: every person's error is the same.
        assert found.g_scale == pytest.approx(1.0, abs=1e-4)


def test_everybody_counts_where_one_camera_saw_all(tmp_path):
    bodies, camera = scene()
    true = truth_of(bodies)
    views = np.ones(true.joints.shape[:3], np.int64)
    write_joints(tmp_path / "joints.npz", replace(true, views=views))
    path = WRITERS[NOT_SEEN](tmp_path, bodies, camera)
    found = scored(NOT_SEEN, path, tmp_path).evaluation
    assert (found.persons, found.track_coverage) == (true.joints.shape[1], 1.0)


def test_table_has_the_papers_rows_and_says_where_a_figure_means_nothing(truth, tmp_path):
    bodies, camera = scene()
    scores = []
    for name in ("hybrik", "wham", "glamr"):
        (tmp_path / name).mkdir()
        path = WRITERS[name](tmp_path / name, wobbled(bodies), camera)
        scores.append(scored(name, path, truth))
    rows = table_rows(scores)
    assert [row[0] for row in rows] == [
        "HybrIK",
        "WHAM",
        "GLAMR",
        "WHAM (per-person)",
        "GLAMR (per-person)",
    ]
    assert rows[0][1:] == ("N/A", "0.0", "N/A", "100.0")
    assert rows[1][1:] == ("N/A", "0.0", "N/A", "100.0")
    assert rows[2][1:] == ("10.0", "0.0", "0.1", "100.0")
    assert rows[3][1:] == rows[4][1:] == rows[2][1:]
    cells = list(csv.reader(io.StringIO(table_csv(scores))))
    assert cells[1] == ["HybrIK", "", "0.0", "", "100.0"]
    latex = table_latex(scores)
    assert latex.count("\\midrule") == 3
    assert "GLAMR & 10.0 & 0.0 & 0.1 & 100.0 \\\\" in latex
    far = scores[2].model_copy(
        update={"evaluation": scores[2].evaluation.model_copy(update={"g_mpjpe_mm": 18888.9})}
    )
    assert "18\\,888.9" in table_latex([far])


def test_method_without_a_common_world_needs_a_camera(truth, tmp_path):
    bodies, camera = scene()
    path = WRITERS["hybrik"](tmp_path, bodies, camera)
    with pytest.raises(UsageError, match="--match-in CAMERA"):
        scored("hybrik", path, truth, match_in=None)
    with pytest.raises(UsageError, match="expected one of hybrik"):
        scored("nobody", path, truth)
    with pytest.raises(UsageError, match="does not exist"):
        scored("hybrik", tmp_path / "nothing", truth)
    with pytest.raises(InputError, match="person_data"):
        scored("glamr", path, truth)


def test_a_file_of_every_second_picture_scores_as_one_of_all(tmp_path):
    bodies, camera = scene()
    # Rigid bodies on straight ways: what lies between two images is known exactly.
    still = BodyParameters(
        bodies.betas,
        np.repeat(bodies.global_orient[:, :1], FRAMES, axis=1),
        np.repeat(bodies.body_pose[:, :1], FRAMES, axis=1),
        bodies.transl,
    )
    write_joints(tmp_path / "joints.npz", truth_of(still))
    write_moving_camera(tmp_path / "cameras" / "clip.npz", camera)
    half = still[:, ::2]
    path = WRITERS["smpl"](tmp_path / "out", half, camera)
    (score,) = score_methods([f"smpl={path}"], str(tmp_path), fps=50.0, seen_fps={"smpl": 25.0})
    # All but the last frame, which lies behind the last image of the half.
    assert score.evaluation.g_mpjpe_mm == pytest.approx(0.0, abs=0.01)
    assert score.notes["resampled"] == "from 25 to 50 images per second, by linear interpolation"
    with pytest.raises(UsageError, match="--method-fps tram"):
        score_methods([f"smpl={path}"], str(tmp_path), fps=50.0, seen_fps={"tram": 25.0})
    with pytest.raises(UsageError, match="--fps"):
        score_methods([f"smpl={path}"], str(tmp_path), seen_fps={"smpl": 25.0})
    write_frame_rates(tmp_path, {"clip": 50.0})
    assert score_methods([f"smpl={path}"], str(tmp_path), seen_fps={"smpl": 25.0}) == (score,)


@pytest.mark.parametrize("text", ["gvhmr", "gvhmr=", "gvhmr=x", "gvhmr=0", "gvhmr=-3", "gvhmr=inf"])
def test_what_is_no_rate_is_refused(text):
    with pytest.raises(UsageError, match="NAME=FPS"):
        named_rates([text])
    assert named_rates(["gvhmr=30"]) == {"gvhmr": 30.0}
