"""Families of detectors: rates and spreads of their errors."""

from __future__ import annotations

from typing import Final, Literal

from data_contracts.records import Record


class DetectorProfile(Record):
    """One family of detectors; spreads are standard deviations."""

    name: str
    definition: float = 0.025
    """From the anatomical joint to what is taken for it, along each axis of its limb [m]; the same
    for all people and cameras."""
    personal: float = 0.006
    """The same, of each person's own [m]."""
    low_hips: float = 0.0
    """What is taken for hips lies this much below the joints' centres [m]."""
    wide_hips: float = 0.0
    """And this much farther outward [m]."""
    view_bias: float = 0.007
    """Bias by the side that is seen, each of two harmonics [person height]."""
    height_bias: float = 0.012
    """Bias along the image's vertical by the sine of the camera's elevation [person height]."""
    noise: float = 0.017
    """Of a person 100 px tall [person height]; relative to their height it falls with the 0.3rd
    power of it."""
    floor: float = 0.5
    """Least noise [px]."""
    resonance: tuple[float, float] = (0.08, 0.45)
    """Period in which a joint's error swings, shortest and longest [s]."""
    tail: float = 3.5
    """Degrees of freedom of the sudden part (Student's t) [1]."""
    sudden: float = 0.5
    """Share of the variance that is new in every frame [1]."""
    limbs: float = 0.45
    """How much of its parent's error a joint has too [1]."""
    grid: float = 0.0
    """Spacing of the grid of places that are reported [person height]; 0 = none."""
    swapped: float = 0.015
    """Share of person-frames in which one part's sides are exchanged; twice from behind [1]."""
    strayed: float = 0.01
    """Share of joints far off for a while [1]: on another person, the other side, the limb."""
    joint_missed: float = 0.02
    """Share of visible joints left out [1]."""
    hidden_kept: float = 0.5
    """Share of hidden joints that are guessed [1]; the others are left out."""
    person_missed: float = 0.02
    """Share of person-frames without a detection [1]."""
    smallest: float = 24.0
    """Half of the people of this height in the image are found [px]."""
    merged: float = 0.4
    """Share of overlaps in which two people become one [1]."""
    ghosts: float = 0.4
    """Lasting false people in a camera, mean number [1]: a bush, a poster."""
    flashes: float = 0.03
    """False people of a single frame, mean number [1]."""
    duplicates: float = 0.006
    """Share of people reported twice [1]."""
    confidence: Literal["honest", "blind", "sure", "meek"] = "honest"
    """`honest` falls with the error, `blind` knows nothing of it, `sure` is high whatever happens,
    `meek` is honest in a small range."""


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
