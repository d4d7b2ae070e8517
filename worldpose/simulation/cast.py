"""Clothes, shape and pose of the people of a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats, Image, Singles
from worldpose.body.model import BodyParameters
from worldpose.simulation.mannequins import (
    Mannequin,
    Role,
    Surfaces,
    draw_kits,
    open_mannequin,
    paint_person,
    pose_people,
    shape_people,
)
from worldpose.simulation.settings import PATTERNS, CrowdSettings, Pattern


@dataclass(frozen=True, eq=False)
class Cast:
    """Dressed people before they are posed.

    Attributes:
        mannequin: common model of all people.
        shaped: (persons, vertices, 3) [m], clothed and unposed.
        images: (persons, 2, rows, columns, 3) RGB, kits from the front and the back.
    """

    mannequin: Mannequin
    shaped: Singles
    images: Image

    def pose(self, poses: BodyParameters) -> Surfaces:
        """Return their surfaces in the poses (persons,) at one time; NaN = missing."""
        return pose_people(self.mannequin, self.shaped, poses)


def dress_people(
    betas: Floats,
    roles: Sequence[Role],
    seed: int,
    patterns: tuple[Pattern, ...] = PATTERNS,
) -> Cast:
    """Return a cast; a person's looks depend on the seed and the person's number alone.

    Args:
        betas: (persons, 10) betas of the open body.
        roles: role of each person.
        seed: draws kits and looks.
        patterns: shirt patterns to draw from.
    """
    mannequin = open_mannequin()
    kits = draw_kits(np.random.default_rng([seed, 5]), patterns)
    numbers: dict[Role, int] = {"first keeper": 0, "second keeper": 0}
    images = []
    for person, role in enumerate(roles):
        numbers[role] = numbers.get(role, 1) + 1
        number = None if role == "official" else numbers[role]
        rng = np.random.default_rng([seed, 6, person])
        images.append(paint_person(kits[role], number, rng))
    shape = (len(roles), *(images[0].shape if images else (2, 1, 1, 3)))
    return Cast(
        mannequin, shape_people(mannequin, betas), np.array(images, dtype=np.uint8).reshape(shape)
    )


def assign_roles(crowd: CrowdSettings, persons: int) -> list[Role]:
    """Return everyone's role, in the order of `worldpose.simulation.movements`."""
    roles: list[Role] = ["first" if person % 2 == 0 else "second" for person in range(persons)]
    if crowd.movement == "football":
        keepers: list[Role] = ["first keeper", "second keeper"]
        roles[:2] = keepers[: min(2, persons)]
        for official in range(max(persons - crowd.officials, 0), persons):
            roles[official] = "official"
    elif crowd.movement == "corner" and persons:
        roles[-1] = "second keeper"
    return roles
