"""Shapes of subjects are pooled, tested, and read from their file."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from faulty_data_sets import COVARIANCE, edit

from flows.results.data_set_subjects import subject_fits
from worldpose.body_fitting.bones import Shape
from worldpose.dataset.subjects import SubjectFit, pool_subjects, read_subjects, write_subjects
from worldpose.errors import InputError


def test_a_subject_has_a_shape_of_each_body_model_and_never_a_mean_of_two(tmp_path):
    def fit(model, clip, first):
        shape = Shape(np.array([first, *np.zeros(9)]), COVARIANCE)
        return SubjectFit("keeper", model, clip, shape, 0.5)

    fits = [
        fit("neutral", "a", 0.4),
        fit("female", "b", 4.0),
        fit("neutral", "c", 0.6),
        SubjectFit("other", "small", "a", Shape(np.ones(4), 0.2 * np.eye(4)), 0.5),
    ]
    write_subjects(tmp_path / "subjects.npz", fits)
    rows = {row[:3]: row.shape for row in read_subjects(tmp_path / "subjects.npz")}
    # Of two clips 2 x 4.5 of information and 0.5 of the prior: 5 (0.4 + 0.6) / 9.5.
    assert rows["keeper", "neutral", ""].betas[0] == pytest.approx(5.0 / 9.5)
    np.testing.assert_allclose(rows["keeper", "neutral", ""].covariance, np.eye(10) / 9.5)
    assert rows["keeper", "female", ""].betas[0] == pytest.approx(4.0)
    assert rows["other", "small", ""].betas.shape == (4,)
    assert len(rows) == 3 + len(fits)


def fit(clip, first, weight=0.5):
    shape = Shape(np.array([first, *np.zeros(9)]), COVARIANCE)
    return SubjectFit("keeper", "neutral", clip, shape, weight)


def test_all_pairs_of_clips_have_one_level_together():
    # The square over the variance is 31: 1 of 1700 pairs of one person is as far apart.
    away = np.sqrt(31.0 * 0.4)
    few = pool_subjects([fit("a", 0.0), fit("b", away)])
    many = pool_subjects([fit("b", away), *(fit(f"{n}", 0.0) for n in range(19))])
    assert few["keeper", "neutral"][1] is None and many["keeper", "neutral"][1] is not None
    # An identity as covariance stands for none: it tells nothing of the shape.
    paper = pool_subjects([fit("a", 0.0, 0.0), fit("b", away, 0.0)])
    assert paper["keeper", "neutral"][1].betas[0] == pytest.approx(0.5 * away)


@pytest.mark.parametrize("place", [("betas", (0, 3)), ("covariance", (0, 3, 3))])
def test_a_gap_in_a_shape_is_refused(tmp_path, place):
    write_subjects(tmp_path / "subjects.npz", [fit("a", 0.0)])
    edit(tmp_path / "subjects.npz", lambda a: a[place[0]].__setitem__(place[1], np.nan))
    with pytest.raises(InputError, match="expected numbers, then NaN to the end"):
        read_subjects(tmp_path / "subjects.npz")


class Run(dict):
    """Results of a run with some settings."""


def fits_of(settings):
    rows = {"betas": (("person", "shape"), np.array([np.ones(10), np.ones(10)]))}
    rows["betas_covariance"] = (("person", "a", "b"), np.stack([COVARIANCE] * 2))
    fits = xr.Dataset(rows, coords={"person": [3, 4]}, attrs={"body_model": "neutral"})
    again = fits.assign_coords(person=[4, 7])  # 7 is filmed by the broadcast camera alone
    run = Run({"body_fitting/A": fits, "refitting/A": again})
    run.record = SimpleNamespace(settings={"body_fitting": settings}, run_id="0001")
    return list(subject_fits("m_A", ("four", "seven"), SimpleNamespace(run=run), "A"))


def test_every_subject_of_a_clip_has_a_row_and_a_shape_by_static_cameras():
    rows = fits_of({"method": "paper", "of_an_older_version": 3})
    assert [(row.subject, len(row.shape.betas)) for row in rows] == [("four", 10), ("seven", 0)]
    assert (rows[0].in_poses, rows[1].in_poses, rows[0].prior_weight) == (True, False, 0.0)
    assert fits_of({"shape_weight": 2.0})[0].prior_weight == 2.0
    with pytest.raises(InputError, match="shape_weight: expected a number"):
        fits_of({"shape_weight": "heavy"})
