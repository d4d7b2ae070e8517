"""Choice of a camera's lens model by its residuals, and the test that a model fits."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import fdtrc

from worldpose.errors import InputError
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.click_outliers import (
    CLEAR_GAIN,
    Explanation,
    covariance_root,
    fit_inliers_at_best_noise,
    negative_log_posterior,
    scale_noise,
)
from worldpose.static_calibration.fit import compute_residuals, fit_cameras
from worldpose.static_calibration.ground_error import pitch_places
from worldpose.static_calibration.parameters import project_with_jacobian
from worldpose.static_calibration.settings import StaticCalibrationSettings

_MIN_CLICKS: Final = 10
"""Minimum number of clicked points that choose a lens model [1]: twenty residuals for twelve
parameters and the noise."""


def choose_lens(found: Explanation, stated: StaticCalibrationSettings) -> Explanation:
    """Return the explanation whose lens model is most probable, Brown's k1 and k2 or a fisheye.

    All models have a posterior at their own noise of clicks, learned from the residuals, so that an
    error of the lens below the stated noise counts, too. Brown's model stands unless another one is
    clearly more probable. A lens that is given, or whose terms a setting restricts, stays.
    """
    # Standard deviation of a fisheye's k1, k2 and k3 [1]: projections from orthographic to
    # stereographic have k1 from -0.17 to 0.08.
    fisheye_std = 0.1
    problem = found.problem
    if problem.lens is not None or stated.distortion != "k1_k2":
        return found
    if len(problem.evidence.points) < _MIN_CLICKS:
        return found
    as_stated = scale_noise(problem, 1.0 / found.noise_factor(stated), found.settings)[0]
    best, own = found, lens_score(found, stated)
    # A robust fit takes a hundredth of the time of the search for outliers.
    loss, worth_it, start = 3.0, 0.9, found.fit.row[None]
    cost = fit_cameras(as_stated, start, click_loss=loss).cost[0]
    lowest = own - CLEAR_GAIN
    # Lens models, and their numbers of free radial coefficients, besides k1 and k2 of Brown's.
    candidates = ((LensModel.BROWN, 3), (LensModel.FISHEYE, 2), (LensModel.FISHEYE, 3))
    for model, coefficients in candidates[: 1 if stated.lens_model == "brown" else None]:
        free = np.arange(STEP) < STEP - 3 + coefficients
        prior = as_stated.prior.copy()
        if model == LensModel.FISHEYE:
            prior[15:18] = fisheye_std
        wider = replace(as_stated, free=free, lens_model=model, prior=prior)
        if fit_cameras(wider, start, click_loss=loss).cost[0] > worth_it * cost:
            continue
        try:
            other = fit_inliers_at_best_noise(wider, found.fit.row, stated)
        except InputError:
            continue
        score = lens_score(other, stated)
        if score < lowest:
            names = "k1 k2 k3"[: 3 * coefficients - 1]
            said = (
                f"{model.label} lens, {names}: the log probability of the clicks is "
                f"{0.5 * (own - score):.0f} higher than with k1 k2 of brown"
            )
            best, lowest = replace(other, assumptions=(said,)), score
    return best


def widen_by_lenses(
    found: Explanation, pitch: PitchTemplate, stated: StaticCalibrationSettings
) -> Explanation:
    """Return the explanation whose region holds the other lenses that fit the clicks as well.

    Few clicks do not tell how a lens bends the image between and beyond them: the covariance is
    that of the chosen model. A lens with three free coefficients and loose priors, Brown's or a
    fisheye, that fits the inliers as well shows the pitch elsewhere. The camera step that best
    follows this displacement of the pitch in the image is an error of one standard deviation; the
    larger one of the two models counts.

    A lens that is given, or whose terms a setting restricts, stays.
    """
    # Spreads of k1, k2, k3 of wide lenses [1], such as those that bend back towards the corners.
    brown, fisheye = (0.3, 0.15, 0.05), (0.3, 0.3, 0.3)
    as_well = 2.0  # difference of the log probabilities [1]
    problem, fit, camera = found.problem, found.fit, found.estimate.camera
    if problem.lens is not None or stated.distortion != "k1_k2":
        return found
    kept = problem.select(fit.inliers, fit.markings)
    cost = fit_cameras(kept, fit.row[None], iterations=0).cost[0]
    places = pitch_places(pitch, 5.0)
    pixels, by_step = project_with_jacobian(camera, places)
    with np.errstate(invalid="ignore"):
        seen = ((pixels >= 0.0) & (pixels <= camera.image_size - 1.0)).all(axis=1)
    widest, largest = np.zeros(STEP), 0.0
    for model, spreads in ((LensModel.BROWN, brown), (LensModel.FISHEYE, fisheye)):
        prior = problem.prior.copy()
        prior[15:18] = spreads
        wider = replace(kept, free=np.ones(STEP, np.bool_), lens_model=model, prior=prior)
        other = fit_cameras(wider, fit.row[None])
        if not other.cost[0] <= cost + as_well * fit.noise_scale**2:
            continue
        apart = Camera.from_numbers(other.rows[0], problem.image_size).project(places) - pixels
        known = seen & np.isfinite(apart).all(axis=1)
        if not known.any():
            continue
        step = np.zeros(STEP)
        rows = by_step[known][:, :, problem.free].reshape(-1, int(problem.free.sum()))
        # In standard deviations: a direction that moves no pixel of the pitch gets no step.
        unit = covariance_root(fit.covariance)[problem.free]
        found_step = np.linalg.lstsq(rows @ unit, apart[known].ravel(), rcond=1e-4)[0]
        step[problem.free] = unit @ found_step
        size = float(np.sqrt(((by_step[known] @ step) ** 2).sum(axis=1).mean()))
        if size > largest:
            widest, largest = step, size
    if largest == 0.0:
        return found
    said = (
        "a lens that fits the clicks as well shows the pitch elsewhere by a root mean square of "
        f"{largest:.1f} px"
    )
    return replace(
        found,
        fit=replace(fit, covariance=fit.covariance + np.outer(widest, widest)),
        assumptions=(*found.assumptions, said),
    )


def lens_score(found: Explanation, stated: StaticCalibrationSettings) -> float:
    """Return minus twice the log posterior of an explanation at its most probable noise."""
    factor = found.noise_factor(stated)
    return min(
        negative_log_posterior(found, factor=factor, with_prior=True, noise_scale=float(scale))
        for scale in np.geomspace(0.2, 5.0, 33) / factor
    )


def describe_misfit(found: Explanation) -> str:
    """Return a reason for review if residuals along the radius follow the radius; empty if not.

    A lens that the model does not describe moves clicks along the radius alone, by a smooth
    function of it: odd powers explain more of these residuals than noise allows (F-test). Several
    excluded clicks may be right, and the lens wrong.
    """
    significance, powers = 1e-3, np.array([1.0, 3.0, 5.0, 7.0, 9.0])
    problem, fit = found.problem, found.fit
    offset = problem.evidence.points_image - fit.row[2:4]
    radius = np.linalg.norm(offset, axis=1)
    residuals = compute_residuals(problem, fit.row).click
    along = (residuals * offset).sum(axis=1) / np.maximum(radius, 1.0)
    everything = np.ones(len(radius), dtype=np.bool_)
    for kept in (fit.inliers, everything)[: 1 + int((~fit.inliers).sum() > 1)]:
        freedom = 2 * int(kept.sum()) - int(problem.free.sum()) - len(powers)
        if kept.sum() < _MIN_CLICKS or freedom < 1:
            continue
        smooth = (radius[kept, None] / problem.half_diagonal) ** powers
        bent = smooth @ np.linalg.lstsq(smooth, along[kept])[0]
        explained = float((bent**2).sum())
        rest = float((residuals[kept] ** 2).sum()) - explained
        ratio = explained / len(powers) / max(rest / freedom, 1e-12)
        if fdtrc(len(powers), freedom, ratio) < significance:
            model = problem.lens_model.label
            return (
                f"the lens bends the image otherwise than the model {model}: up to "
                f"{np.abs(bent).max():.1f} px along the radius at the clicks. Calibrate the lens "
                "with a board (worldpose calibrate), and import it (worldpose import --lens)"
            )
    return ""
