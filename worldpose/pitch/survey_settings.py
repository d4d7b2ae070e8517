"""Settings of laying a survey onto the world frame."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class SurveySettings(Record):
    """What a survey may look like, and what is taken where it cannot tell."""

    left_handed: bool = False
    """The survey's x, y and height are a left-handed frame, as x north and y east are."""
    fit_scale: bool = False
    """Divide by the survey's scale, as that of a map projection, instead of only reporting it."""
    accuracy: float = Field(default=0.03, ge=1e-6, le=10)
    """Within which painted markings follow the Laws of the Game [m]: a quarter of a line."""
    largest_offset: float = Field(default=1.0, ge=1e-6, le=100)
    """Beyond which a point has another's name [m]: no painter is that far off."""
    largest_scale: float = Field(default=0.08, ge=1e-6, le=10)
    """Beyond which lengths have another unit [1]: yards are 9 % off; of a survey of the corners
    alone, pitches of 97 to 113 m by 63 to 73 m pass."""
    length_spread: float = Field(default=5.0, ge=1e-6, le=1000)
    """Of pitches about 105 m [m]: decides where the survey does not."""
    width_spread: float = Field(default=4.0, ge=1e-6, le=1000)
    """Of pitches about 68 m [m]: as `length_spread`."""
    crown_spread: float = Field(default=0.1, ge=1e-6, le=10)
    """Of crowns about 0.2 m [m]: as `length_spread`."""
    slope_spread: float = Field(default=0.01, ge=1e-6, le=1)
    """Of the pitch's fall from one side to another [1]: 1 %, the most that sport grounds have."""
