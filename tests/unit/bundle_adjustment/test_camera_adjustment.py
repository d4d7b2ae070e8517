"""Cameras adjusted to people and markings, against known truth."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import errors

from worldpose.bundle_adjustment.clip import Clicks
from worldpose.bundle_adjustment.estimate import adjust_cameras
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, SolverSettings
from worldpose.errors import InputError

QUICK = BundleAdjustmentSettings(max_frames=8, folds=2, solver=SolverSettings(min_cost_change=1e-6))


def test_people_bring_cameras_together(clip):
    made, true, _ = clip()
    adjusted = adjust_cameras(made, QUICK)
    assert adjusted.accepted.all()
    # Scatter of a pixel's rotation and of decimetres becomes what 800 keypoints per camera leave;
    # what all cameras share stays as calibration has it.
    assert errors(adjusted.cameras, true).mean() < 0.4 * errors(made.cameras, true).mean()
    assert (adjusted.verdict.loss[:, 1] < adjusted.verdict.loss[:, 0]).all()
    assert all(reason.startswith("accepted") for reason in adjusted.reasons)


def test_covariance_covers_the_error(clip):
    squared = []
    for seed in range(8):
        made, true, _ = clip(seed=seed, lasting=0.7)
        adjusted = adjust_cameras(made, QUICK)
        center = adjusted.cameras.center - true.center
        rotation = true.cam_from_world.rotation
        spread = rotation.swapaxes(1, 2) @ adjusted.covariance[:, 3:6, 3:6] @ rotation
        squared += [off @ np.linalg.solve(s, off) for off, s in zip(center, spread, strict=True)]
    # Chi-square with three degrees of freedom: 40 values have a mean of 3 +- 0.4 if they were
    # independent, and those of one trial share the world's place.
    assert 1.8 < np.mean(squared) < 4.5


def test_markings_alone_are_refused_where_they_bend_the_camera(clip):
    made, true, _ = clip(clicked=6, seed=2)
    clustered = []
    for clicks in made.clicks:
        # All in a tenth of the pitch: the lens is free to do anything elsewhere.
        near = 0.3 * clicks.points_world + [14.0, 14.0, 0.0]
        clustered.append(near)
    rng = np.random.default_rng(5)
    made = replace(
        made,
        clicks=tuple(
            replace(
                clicks,
                points_world=near,
                points_image=true[c].project(near) + 1.5 * rng.standard_normal((6, 2)),
            )
            for c, (clicks, near) in enumerate(zip(made.clicks, clustered, strict=True))
        ),
    )
    adjusted = adjust_cameras(made, QUICK.model_copy(update={"evidence": "markings"}))
    assert errors(adjusted.refused, true).max() > 2.0 * errors(made.cameras, true).max()
    assert not adjusted.accepted.any()
    np.testing.assert_array_equal(adjusted.cameras.numbers, made.cameras.numbers)
    np.testing.assert_array_equal(adjusted.covariance, made.covariance)
    assert all(reason.startswith("refused: the loss of") for reason in adjusted.reasons)


@pytest.mark.parametrize("case", ["nobody", "one camera", "two cameras in line", "no markings"])
def test_what_tells_nothing_leaves_cameras_as_they_were_and_says_why(clip, case):
    if case == "one camera":
        made, *_ = clip(cameras=1)
    elif case == "two cameras in line":
        made, *_ = clip(cameras=2)
    else:
        made, *_ = clip(frames=6)
    settings, reason = QUICK, "no person has enough inlier cameras"
    if case == "nobody":
        made = replace(made, joints=np.full_like(made.joints, np.nan))
    if case == "no markings":
        count = len(made.clicks)
        made = replace(made, clicks=(Clicks.none(),) * count)
        settings = QUICK.model_copy(update={"evidence": "markings"})
        reason = "no camera has a clicked marking"
    adjusted = adjust_cameras(made, settings)
    assert not adjusted.accepted.any()
    np.testing.assert_array_equal(adjusted.cameras.numbers, made.cameras.numbers)
    assert all(reason in said for said in adjusted.reasons)


@pytest.mark.parametrize("evidence", ["markings_and_players", "markings"])
def test_the_papers_adjustment_finds_the_cameras_of_exact_markings_and_people(clip, evidence):
    pytest.importorskip("torch")
    from worldpose.bundle_adjustment.paper_variant import adjust_unguarded

    made, true, _ = clip(noise=0.0, clicked=14)
    exact = tuple(
        replace(one, points_image=true[c].project(one.points_world))
        for c, one in enumerate(made.clicks)
    )
    made = replace(made, clicks=exact)
    settings, frames = BundleAdjustmentSettings(evidence=evidence), np.arange(8)
    found = adjust_unguarded(made, settings, frames, frames)
    assert found.accepted.all()
    np.testing.assert_allclose(found.cameras.center, true.center, atol=1e-3)
    tangential = replace(made.cameras, distortion=made.cameras.distortion + 0.001)
    with pytest.raises(InputError, match="tangential"):
        adjust_unguarded(replace(made, cameras=tangential), settings, frames, frames)
