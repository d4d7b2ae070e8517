"""Validation of a survey before and after its alignment with the world frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.pitch.laws import law_points
from worldpose.pitch.survey_file import Survey
from worldpose.pitch.survey_settings import SurveySettings

STANDARD_SIZE = (105.0, 68.0)
"""Initial length and width of a pitch [m]."""


def law_places(survey: Survey) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions of the survey's points in the Laws of the Game.

    Returns:
        Positions (n, 3) [m] on a pitch of no length and width, z above the surface, and the change
        of x by length and of y by width (n, 2) [1].
    """
    base, larger = law_points(0.0, 0.0), law_points(1.0, 1.0)
    at = np.array([base[name] for name in survey.names]).reshape(-1, 3)
    change = np.array([larger[name] for name in survey.names]).reshape(-1, 3) - at
    return at, change[:, :2]


def nominal_places(survey: Survey) -> NDArray[np.float64]:
    """Return the points' positions in plan (n, 2) [m] on a pitch of 105 x 68 m."""
    law, change = law_places(survey)
    return np.asarray(law[:, :2] + change * STANDARD_SIZE)


def best_turn(centred: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (2, 2) that brings centred points nearest to others."""
    (a, b), (c, d) = centred.T @ (places - places.mean(axis=0))
    return plane_rotation(float(np.arctan2(b - c, a + d)))


def plane_rotation(angle: float) -> NDArray[np.float64]:
    """Return the rotation (2, 2) by an angle [rad], from x towards y."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


def require_spread(survey: Survey) -> None:
    """Reject fewer than four points, or points near one line.

    Raises:
        InputError: it names the points.
    """
    enough = len(survey.names) >= 4
    for places in (survey.places[:, :2], nominal_places(survey)) if enough else ():
        extents = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        enough = enough and extents[1] > 0.05 * extents[0]
    if not enough:
        raise InputError(
            survey.where,
            expected="at least four points that do not lie near one line",
            found=f"{len(survey.names)}: {', '.join(survey.names) or 'none'}",
            todo="Survey the four corners, and the penalty areas where there is time.",
        )


def require_orientation(
    survey: Survey, places: NDArray[np.float64], settings: SurveySettings
) -> None:
    """Reject a survey whose mirror image fits far better than the survey.

    Args:
        survey: for its names and messages.
        places: (n, 2) [m], in a right-handed frame if the settings are correct.
        settings: stated handedness of the frame.

    Raises:
        InputError: it names possible causes.
    """
    nominal = nominal_places(survey)
    target = nominal - nominal.mean(axis=0)
    errors = []
    for mirror in ((1.0, 1.0), (1.0, -1.0)):
        centred = (places - places.mean(axis=0)) * mirror
        centred = centred * np.linalg.norm(target) / np.linalg.norm(centred)
        off = centred @ best_turn(centred, target).T - target
        errors.append(float(np.median(np.linalg.norm(off, axis=-1))))
    if errors[1] < 0.5 * errors[0]:
        raise InputError(
            survey.where,
            expected="left and right, near and far as seen from the main camera",
            found="a mirror image of the pitch",
            todo="Exchange left and right in the names, or say that the frame is "
            f"{'right' if settings.left_handed else 'left'}-handed (x north and y east are "
            "left-handed; columns named easting and northing need not say so).",
        )


def require_names(survey: Survey, offsets: NDArray[np.float64], settings: SurveySettings) -> None:
    """Reject points that are far from the positions of their names.

    Args:
        survey: for its names and messages.
        offsets: (n, 2) of the aligned survey from the Laws [m].
        settings: largest plausible error of the markings.

    Raises:
        InputError: it names the points.
    """
    offset = np.linalg.norm(offsets, axis=-1)
    far = [
        f"{survey.names[n]} ({offset[n]:.2f} m)"
        for n in np.argsort(-offset)
        if offset[n] > settings.largest_offset
    ]
    if far:
        raise InputError(
            survey.where,
            expected=f"every point within {settings.largest_offset:g} m of where its name belongs",
            found=f"farther off: {', '.join(far[:6])}",
            todo="Exchange or correct these names, or take the points out.",
        )
