"""The people of a film: team, clothes, shape and pose of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body import BodyParameters
from worldpose.geometry import Rigid
from worldpose.pitch import PitchTemplate
from worldpose.simulation.figures import draw_figure
from worldpose.simulation.kits import Kit, Role, draw_kits, paint_person
from worldpose.simulation.looks import PATTERNS, Pattern
from worldpose.simulation.mannequins import (
    Mannequin,
    Surfaces,
    open_mannequin,
    pose_people,
    shape_people,
)
from worldpose.simulation.props import Prop
from worldpose.simulation.settings import CrowdSettings

BEHIND: Final = (2.5, 3.3)
"""Distance of bystanders behind the lines and before the boards [m]."""


@dataclass(frozen=True, eq=False)
class Cast:
    """Dressed people before they are posed.

    Attributes:
        mannequin: common model of all people.
        shaped: (persons, vertices, 3) [m], clothed and unposed.
        pictures: (persons, 2, rows, columns, 3) RGB, kits from the front and the back.
    """

    mannequin: Mannequin
    shaped: NDArray[np.float32]
    pictures: NDArray[np.uint8]

    def posed(self, poses: BodyParameters) -> Surfaces:
        """Return their surfaces in the poses (persons,) at one time; NaN = missing."""
        return pose_people(self.mannequin, self.shaped, poses)


def dress_people(
    betas: NDArray[np.float64],
    roles: Sequence[Role],
    seed: int,
    patterns: tuple[Pattern, ...] = PATTERNS,
) -> Cast:
    """Return a cast; a person's looks depend on the seed and the person's number alone.

    Args:
        betas: (persons, 10) of the open body.
        roles: of each.
        seed: draws kits and looks.
        patterns: shirt patterns to draw from.
    """
    mannequin = open_mannequin()
    kits = draw_kits(np.random.default_rng([seed, 5]), patterns)
    numbers: dict[Role, int] = {"first keeper": 0, "second keeper": 0}
    pictures = []
    for person, role in enumerate(roles):
        numbers[role] = numbers.get(role, 1) + 1
        number = None if role == "official" else numbers[role]
        rng = np.random.default_rng([seed, 6, person])
        pictures.append(paint_person(kits[role], number, rng))
    shape = (len(roles), *(pictures[0].shape if pictures else (2, 1, 1, 3)))
    return Cast(
        mannequin,
        shape_people(mannequin, betas),
        np.array(pictures, dtype=np.uint8).reshape(shape),
    )


def stand_by(pitch: PitchTemplate, count: int, seed: int) -> tuple[Prop, ...]:
    """Return bystanders who stand off the pitch and watch."""
    rng = np.random.default_rng([seed, 8])
    along, side = rng.uniform(-0.9, 0.9, count), rng.integers(4, size=count)
    behind = rng.uniform(*BEHIND, count)
    half = 0.5 * np.array([pitch.length, pitch.width])
    props = []
    for share, which, off in zip(along, side, behind, strict=True):
        axis, toward = divmod(int(which), 2)
        place = np.empty(2)
        place[1 - axis], place[axis] = share * half[1 - axis], (2 * toward - 1) * (half[axis] + off)
        betas = draw_figure((1.55, 1.9), rng).betas
        bib = _plain(rng.uniform(0.1, 0.9, 3), rng)
        props.append(_stander(betas, place, pitch, paint_person(bib, None, rng), rng))
    return tuple(props)


def _plain(color: NDArray[np.float64], rng: np.random.Generator) -> Kit:
    dark = rng.uniform(0.05, 0.3, 3)
    return Kit(color, 0.8 * color, "plain", dark, dark, dark, float(rng.choice([0.42, 0.74])))


def _stander(
    betas: NDArray[np.float64],
    place: NDArray[np.float64],
    pitch: PitchTemplate,
    picture: NDArray[np.uint8],
    rng: np.random.Generator,
) -> Prop:
    """Return a person with hanging arms on the grass who faces the middle of the pitch."""
    mannequin = open_mannequin()
    course = np.arctan2(-place[1], -place[0]) + rng.normal(0.0, 0.5)
    upright = Rigid.from_rotvec(np.array([0.5 * np.pi, 0.0, 0.0]), np.zeros(3)).rotation
    # The upright model faces -y.
    turned = Rigid.from_rotvec(np.array([0.0, 0.0, course + 0.5 * np.pi]), np.zeros(3)).rotation
    pose = np.zeros((23, 3))
    pose[15, 2], pose[16, 2] = -rng.uniform(1.0, 1.3), rng.uniform(1.0, 1.3)
    poses = BodyParameters(
        betas[None],
        Rigid(turned @ upright, np.zeros(3)).rotvec[None],
        pose.reshape(1, 69),
        np.array([[*place, float(pitch.height(*place))]]),
    )
    surfaces = pose_people(mannequin, shape_people(mannequin, betas[None]), poses)
    sole = surfaces.vertices[0, :, 2].min() - poses.transl[0, 2]
    standing = Surfaces(
        surfaces.vertices - np.array([0.0, 0.0, sole], dtype=np.float32), surfaces.normals
    )
    return Prop(mannequin.faces, mannequin.backs, mannequin.texels, picture, standing, shadow=True)


def roles_of(crowd: CrowdSettings, persons: int) -> list[Role]:
    """Return everyone's role, in the order of `worldpose.simulation.football` and `contests`."""
    roles: list[Role] = ["first" if person % 2 == 0 else "second" for person in range(persons)]
    if crowd.movement == "football":
        keepers: list[Role] = ["first keeper", "second keeper"]
        roles[:2] = keepers[: min(2, persons)]
        for official in range(max(persons - crowd.officials, 0), persons):
            roles[official] = "official"
    elif crowd.movement == "corner" and persons:
        roles[-1] = "second keeper"
    return roles
