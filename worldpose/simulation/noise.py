"""Noise model of a 2D pose detector: one rate for each kind of error."""

from __future__ import annotations

from typing import Self

from pydantic import Field

from data_contracts.records import Record


class ObservationNoise(Record):
    """Errors of a 2D pose detector on people who are small in the image.

    A joint's error is a bias (`shared_bias`, `own_bias`, `view_bias`), a part that drifts (`slow`)
    and one that is independent per frame (`white`, `floor`, `blur`). White noise alone would
    average out over ten views and fifty frames per second.

    Spreads are standard deviations per image axis. Those relative to a person's height in the image
    are for a joint of average difficulty; each joint's own is in proportion to its COCO sigma (eyes
    a third, hips four thirds).
    """

    white: float = Field(default=0.015, ge=0, le=10)
    """Independent error per frame [person height]: typical of heatmap detectors on people of 100
    px; with `slow` it comes to 2 % of the height, 4 cm."""
    slow: float = Field(default=0.015, ge=0, le=10)
    """Error that drifts [person height]: a pose, a shirt or a background misleads for a while, so
    that averaging over frames does not remove it."""
    slow_time: float = Field(default=0.3, gt=0, le=100)
    """Time constant of the drift's correlation [s]: a fraction of a stride."""
    floor: float = Field(default=0.5, ge=0, le=100)
    """Added to `white` in squares [px]: the limit of a heatmap's grid."""
    blur: float = Field(default=0.002, ge=0, le=1)
    """Error along a joint's motion in the image, as the time in which the joint moves that far [s]:
    a share of the exposure, 4 to 10 ms under floodlight."""
    shared_bias: float = Field(default=0.008, ge=0, le=1)
    """Offset of the detector's joint from the true one along each axis of the body [m]: one vector
    per joint (mirrored on the other side), the same for all people and cameras, because it is the
    joint definition of the training labels. No number of views removes it."""
    own_bias: float = Field(default=0.004, ge=0, le=1)
    """The same, drawn for every person [m]: clothes and build."""
    view_bias: float = Field(default=0.005, ge=0, le=1)
    """Bias that varies with the viewing direction of a body, with two periods per turn (front and
    back are alike, sides differ) [person height]; the same for all people and cameras."""
    fewest_joints: int = Field(default=5, ge=0, le=1000)
    """A person with fewer joints in the image is not found [1]: detectors need a body, not a hand
    at the border."""
    joint_missed: float = Field(default=0.02, ge=0, le=1)
    """Share of visible joints not reported [1]: detectors omit those of low confidence."""
    person_missed: float = Field(default=0.03, ge=0, lt=1)
    """Share of frames in which a visible person is not found at all [1]."""
    person_missed_time: float = Field(default=0.2, gt=0, le=100)
    """Mean length of such a gap [s]: misses come in bursts, because the image hardly changes."""
    hidden_spread: float = Field(default=1.0, ge=0, le=100)
    """Additional error of a joint hidden behind a person, in units of its usual one [1]: the
    detector guesses from the rest of the body; 1 doubles the error."""
    hidden_joint_missed: float = Field(default=0.4, ge=0, le=1)
    """Share of hidden joints not reported [1]."""
    stolen: float = Field(default=0.1, ge=0, lt=1)
    """Share of hidden joints reported at the same joint of the occluding person [1]."""
    stolen_time: float = Field(default=0.15, gt=0, le=100)
    """Mean length of such an interval [s]."""
    hidden_person_missed: float = Field(default=0.9, ge=0, le=1)
    """Share of frames in which a mostly hidden person is not found [1]: two boxes with that much
    overlap become one."""
    merged: float = Field(default=0.5, ge=0, le=1)
    """Share of those lost persons whose box is merged: the nearer person's box then covers both
    [1]."""
    swapped: float = Field(default=0.02, ge=0, lt=1)
    """Share of person-frames with a left-right swap [1]: a back that looks like a front."""
    swapped_time: float = Field(default=0.15, gt=0, le=100)
    """Mean length of such a swap [s]."""
    small: float = Field(default=60.0, ge=0, le=10000)
    """People smaller than this in the image have twice the rate of misses and swaps [px]."""
    displaced: float = Field(default=0.0, ge=0, lt=1)
    """Share of joints with gross errors of 4 to 10 standard deviations, at full confidence [1]; the
    ground truth flags them."""
    dropped_frames: float = Field(default=0.0, ge=0, lt=1)
    """Share of frames that a camera lost [1]."""
    dropped_time: float = Field(default=0.06, gt=0, le=10)
    """Mean length of such a gap [s]."""
    false_people: float = Field(default=0.1, ge=0, lt=1)
    """False positives, mean number per frame and camera [1]: shadows, boards."""
    false_people_time: float = Field(default=0.3, gt=0, le=100)
    """Mean duration of one [s]."""
    false_doubt: float = Field(default=0.4, ge=0, lt=1)
    """Reduction of their confidence, as a share of it [1]."""
    confidence_drop: float = Field(default=8.0, ge=0, le=1000)
    """A joint with error e [person height], biases aside, has confidence exp(-drop e) [1]: 0.85 at
    2 %; confidence reflects random errors, not systematic ones."""
    hidden_doubt: float = Field(default=0.5, ge=0, lt=1)
    """Reduction of a hidden joint's confidence, as a share of it [1]."""
    confidence_spread: float = Field(default=0.05, ge=0, le=10)
    """Error of the confidence itself, relative [1]: confidence reflects the error without revealing
    it."""

    @classmethod
    def none(cls) -> Self:
        """Return a detector that reports every joint in the image exactly, with confidence 1."""
        rates = [name for name in cls.model_fields if not name.endswith("_time")]
        return cls(**dict.fromkeys(rates, 0.0))
