"""How a detector errs: one rate for each kind of error."""

from __future__ import annotations

from typing import Self

from pydantic import Field

from data_contracts.records import Record


class ObservationNoise(Record):
    """Errors of a 2D pose detector on people who are small in the picture.

    A joint's error is a bias (`shared_bias`, `own_bias`, `view_bias`), a part that drifts (`slow`)
    and one that is new in every frame (`white`, `floor`, `blur`). White noise alone would average
    away over ten views and fifty frames a second.

    Spreads are standard deviations per image axis. Those relative to a person's height in the
    picture hold for a joint of average difficulty; each joint's own is in proportion to its COCO
    sigma (eyes a third, hips four thirds).
    """

    white: float = Field(default=0.015, ge=0, le=10)
    """Error anew in every frame [person height]: what heatmap detectors show on people of 100 px;
    with `slow` it comes to 2 % of the height, 4 cm."""
    slow: float = Field(default=0.015, ge=0, le=10)
    """Error that drifts [person height]: a pose, a shirt or a background misleads for a while, so
    that averaging over frames does not remove it."""
    slow_time: float = Field(default=0.3, gt=0, le=100)
    """Time in which the drift forgets itself by a factor e [s]: a fraction of a stride."""
    floor: float = Field(default=0.5, ge=0, le=100)
    """Added to `white` in squares [px]: no detector beats its heatmap's grid."""
    blur: float = Field(default=0.002, ge=0, le=1)
    """Error along a joint's motion in the picture, as the time in which it goes that far [s]: a
    share of the exposure, 4 to 10 ms under floodlight."""
    shared_bias: float = Field(default=0.008, ge=0, le=1)
    """What the detector takes for a joint differs from the joint by this much along each axis of
    the body [m]: one vector a joint (mirrored on the other side), the same for all people and
    cameras, for it is the training labels' idea of a joint. No number of views removes it."""
    own_bias: float = Field(default=0.004, ge=0, le=1)
    """The same, drawn for every person anew [m]: clothes and build."""
    view_bias: float = Field(default=0.005, ge=0, le=1)
    """Bias that varies with the direction a body is seen from, twice a turn (front and back are
    alike, sides differ) [person height]; the same for all people and cameras."""
    fewest_joints: int = Field(default=5, ge=0, le=1000)
    """A person with fewer joints in the picture is not found [1]: detectors want a body, not a
    hand at the border."""
    joint_missed: float = Field(default=0.02, ge=0, le=1)
    """Share of visible joints not reported [1]: detectors withhold the least sure ones."""
    person_missed: float = Field(default=0.03, ge=0, lt=1)
    """Share of frames in which a visible person is not found at all [1]."""
    person_missed_time: float = Field(default=0.2, gt=0, le=100)
    """Mean length of such a gap [s]: misses come in bursts, for the picture hardly changes."""
    hidden_spread: float = Field(default=1.0, ge=0, le=100)
    """Further error of a joint hidden behind a person, in units of its usual one [1]: the
    detector guesses from the rest of the body; 1 doubles the error."""
    hidden_joint_missed: float = Field(default=0.4, ge=0, le=1)
    """Share of hidden joints not reported [1]."""
    stolen: float = Field(default=0.1, ge=0, lt=1)
    """Share of hidden joints reported where the person before has that joint [1]."""
    stolen_time: float = Field(default=0.15, gt=0, le=100)
    """Mean length of such a theft [s]."""
    hidden_person_missed: float = Field(default=0.9, ge=0, le=1)
    """Share of frames in which a mostly hidden person is not found [1]: one box is left of two
    when they overlap that much."""
    merged: float = Field(default=0.5, ge=0, le=1)
    """Share of persons lost so whose box is taken over: the nearer one's then holds both [1]."""
    swapped: float = Field(default=0.02, ge=0, lt=1)
    """Share of person-frames with left and right exchanged [1]: backs taken for fronts."""
    swapped_time: float = Field(default=0.15, gt=0, le=100)
    """Mean length of such an exchange [s]."""
    small: float = Field(default=60.0, ge=0, le=10000)
    """People smaller than this in the picture are missed and exchanged twice as often [px]."""
    displaced: float = Field(default=0.0, ge=0, lt=1)
    """Share of joints put 4 to 10 standard deviations off, with no loss of confidence [1]; the
    truth says which."""
    dropped_frames: float = Field(default=0.0, ge=0, lt=1)
    """Share of frames that a camera lost [1]."""
    dropped_time: float = Field(default=0.06, gt=0, le=10)
    """Mean length of such a gap [s]."""
    false_people: float = Field(default=0.1, ge=0, lt=1)
    """People reported where nobody is, mean number a frame and camera [1]: shadows, boards."""
    false_people_time: float = Field(default=0.3, gt=0, le=100)
    """Mean time one of them stays [s]."""
    false_doubt: float = Field(default=0.4, ge=0, lt=1)
    """By how much they lower the confidence, as a share of it [1]."""
    confidence_drop: float = Field(default=8.0, ge=0, le=1000)
    """A joint with error e [person height], biases aside, has confidence exp(-drop e) [1]: 0.85 at
    2 %; a detector knows when it is unsure, not what it always gets wrong."""
    hidden_doubt: float = Field(default=0.5, ge=0, lt=1)
    """By how much being hidden lowers a joint's confidence, as a share of it [1]."""
    confidence_spread: float = Field(default=0.05, ge=0, le=10)
    """Error of the confidence itself, relative [1]: it reflects the truth, not gives it away."""

    @classmethod
    def none(cls) -> Self:
        """A detector that reports every joint in the picture, exactly and surely."""
        rates = [name for name in cls.model_fields if not name.endswith("_time")]
        return cls(**dict.fromkeys(rates, 0.0))
