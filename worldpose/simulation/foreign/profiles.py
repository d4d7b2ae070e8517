"""Families of detectors: rates and spreads of their errors."""

from __future__ import annotations

from typing import Final, Literal

from data_contracts.records import Record


class DetectorProfile(Record):
    """One family of detectors; spreads are standard deviations."""

    name: str
    definition: float = 0.025
    """From the anatomical joint to the detector's, along each axis of its limb [m]; the same for
    all people and cameras."""
    personal: float = 0.006
    """The same, for each person [m]."""
    low_hips: float = 0.0
    """Offset of the detector's hips below the joints' centres [m]."""
    wide_hips: float = 0.0
    """Offset of the detector's hips outward [m]."""
    view_bias: float = 0.007
    """Bias by azimuth, each of two harmonics [person height]."""
    height_bias: float = 0.012
    """Bias along the image's vertical by the sine of the camera's elevation [person height]."""
    noise: float = 0.017
    """Noise on a person 100 px tall [person height]; it is proportional to the -0.3rd power of the
    height in the image."""
    floor: float = 0.5
    """Minimum noise [px]."""
    resonance: tuple[float, float] = (0.08, 0.45)
    """Period of a joint's oscillating error, minimum and maximum [s]."""
    tail: float = 3.5
    """Degrees of freedom of the sudden part (Student's t) [1]."""
    sudden: float = 0.5
    """Share of the variance that is independent per frame [1]."""
    limbs: float = 0.45
    """Share of its parent's error in a joint's error [1]."""
    grid: float = 0.0
    """Spacing of the grid of reported positions [person height]; 0 = none."""
    swapped: float = 0.015
    """Share of person-frames with a left-right swap of one part; twice from behind [1]."""
    strayed: float = 0.01
    """Share of joints with temporary gross errors [1]: on another person, the other side, the
    limb."""
    joint_missed: float = 0.02
    """Share of visible joints left out [1]."""
    hidden_kept: float = 0.5
    """Share of hidden joints that are guessed [1]; the others are left out."""
    person_missed: float = 0.02
    """Share of person-frames without a detection [1]."""
    smallest: float = 24.0
    """Height at which half of the people in the image are found [px]."""
    merged: float = 0.4
    """Share of overlaps in which two people merge into one detection [1]."""
    ghosts: float = 0.4
    """Persistent false positives in a camera, mean number [1]: a bush, a poster."""
    flashes: float = 0.03
    """False positives of a single frame, mean number [1]."""
    duplicates: float = 0.006
    """Share of people reported twice [1]."""
    confidence: Literal["honest", "blind", "sure", "meek"] = "honest"
    """`honest` falls with the error, `blind` is independent of it, `sure` is always high, `meek` is
    honest in a small range."""


PROFILES: Final = {
    profile.name: profile
    for profile in (
        DetectorProfile(name="heatmap-large", noise=0.011, grid=0.004, view_bias=0.005),
        DetectorProfile(
            name="heatmap-small",
            noise=0.021,
            grid=1.0 / 64.0,
            low_hips=0.03,
            confidence="sure",
            strayed=0.015,
        ),
        DetectorProfile(
            name="regression",
            noise=0.02,
            sudden=0.15,
            limbs=0.8,
            resonance=(0.3, 1.2),
            hidden_kept=1.0,
            joint_missed=0.0,
            confidence="blind",
        ),
        DetectorProfile(
            name="bottom-up",
            noise=0.019,
            tail=2.6,
            wide_hips=0.02,
            strayed=0.03,
            merged=0.7,
            joint_missed=0.06,
            hidden_kept=0.15,
            confidence="meek",
        ),
        DetectorProfile(
            name="old-box",
            noise=0.025,
            floor=1.0,
            swapped=0.035,
            person_missed=0.06,
            ghosts=1.0,
            flashes=0.1,
            duplicates=0.02,
            low_hips=0.05,
            wide_hips=0.015,
        ),
        DetectorProfile(
            name="sports-tuned",
            noise=0.014,
            definition=0.02,
            swapped=0.006,
            smallest=15.0,
            merged=0.25,
            confidence="sure",
        ),
    )
}
"""Profiles by name; a match has one of them."""
