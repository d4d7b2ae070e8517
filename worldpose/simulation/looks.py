"""Look of a scenario's images: light, weather, kits, lens and sensor."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from data_contracts.records import Record

Pattern = Literal["plain", "sleeves", "stripes", "hoops", "band", "halves", "sash", "chequers"]

PATTERNS: Final[tuple[Pattern, ...]] = (
    "plain",
    "plain",
    "sleeves",
    "stripes",
    "hoops",
    "band",
    "halves",
    "sash",
    "chequers",
)
"""Of shirts; plain ones are the most common."""


class RenderingSettings(Record):
    """Look of an image."""

    stripes: float = Field(default=0.16, ge=0, le=1)
    """Brightness of a mown stripe against its neighbour [1]; 0.1 to 0.2 in broadcast images."""
    paint: float = Field(default=1.0, ge=0, le=1)
    """Share of the grass that fresh paint hides [1]; 0 = no markings."""
    light: Literal["sun", "floodlights"] = "sun"
    """One hard shadow per person, or four faint ones."""
    stand_shadow: float = Field(default=0.45, ge=0, le=1)
    """Share of the light that a stand blocks on a part of the pitch [1], if the sun shines; 0 = no
    such shadow."""
    fog: float = Field(default=0.0, ge=0, le=100)
    """Extinction [1/m]; at 0.01 a third of the contrast is left at 100 m."""
    exposure: float = Field(default=1.0, gt=0, le=100)
    """Brightness of the whole image [1]."""
    patterns: tuple[Pattern, ...] = PATTERNS
    """Shirt patterns to draw from."""
    bystanders: int = Field(default=0, ge=0, le=100)
    """People who stand 2.5 to 3.3 m behind the lines and do not play [1]: ball boys, stewards,
    photographers. The ground truth does not include them."""
    shutter: float = Field(default=0.004, ge=0, le=1)
    """Exposure time of every frame [s]: 1/250 s, usual for sport by day."""
    blur: float = Field(default=0.7, ge=0, le=100)
    """Standard deviation of the lens's and the codec's blur [px]; a sharp broadcast lens."""
    noise: float = Field(default=2.0, ge=0, le=1000)
    """Standard deviation of the sensor's noise [levels of 255], after a broadcast codec."""
