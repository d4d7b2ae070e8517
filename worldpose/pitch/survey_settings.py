"""Settings of the alignment of a survey with the world frame."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class SurveySettings(Record):
    """Plausible properties of a survey, and priors where it determines nothing."""

    left_handed: bool = False
    """Whether x, y and height of the survey are a left-handed frame, such as x north and y east."""
    fit_scale: bool = False
    """Divide by the survey's scale, as of a map projection, instead of only reporting it."""
    accuracy: float = Field(default=0.03, ge=1e-6, le=10)
    """Standard deviation of painted markings from the Laws of the Game [m]: a quarter of a line."""
    largest_offset: float = Field(default=1.0, ge=1e-6, le=100)
    """Offset beyond which a point's name is wrong [m]: no painter errs by that much."""
    largest_scale: float = Field(default=0.08, ge=1e-6, le=10)
    """Deviation of the scale from 1 beyond which lengths have another unit [1]: yards differ by 9
    %; a survey of the corners alone passes for pitches of 97 to 113 m by 63 to 73 m."""
    length_spread: float = Field(default=5.0, ge=1e-6, le=1000)
    """Standard deviation of pitch lengths around 105 m [m]: prior of a length not surveyed."""
    width_spread: float = Field(default=4.0, ge=1e-6, le=1000)
    """Standard deviation of pitch widths around 68 m [m]: as `length_spread`."""
    crown_spread: float = Field(default=0.1, ge=1e-6, le=10)
    """Standard deviation of crowns around 0.2 m [m]: as `length_spread`."""
    slope_spread: float = Field(default=0.01, ge=1e-6, le=1)
    """Standard deviation of the pitch's slope across it [1]: 1 %, the most on sport grounds."""
