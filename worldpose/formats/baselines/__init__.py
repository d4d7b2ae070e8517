"""Baseline methods: readers for the results of other methods on one clip.

Inputs: the files that a method's own code wrote, and the body model for its poses. Outputs:
    `MethodResult`: joints, their world frame, boxes in the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from worldpose.body.model import BodyModel
from worldpose.errors import UsageError
from worldpose.formats.baselines import methods
from worldpose.formats.baselines.result import MethodResult, Person, Poser, World, merge_people


@dataclass(frozen=True)
class Method:
    """A supported baseline method."""

    name: str
    """Name on the command line."""
    title: str
    """Name in tables."""
    world: World
    people: Callable[[Path, Poser, tuple[int, int]], Iterator[Person]]

    def read(self, path: Path, model: BodyModel, image_size: tuple[int, int]) -> MethodResult:
        """Return the people of a result in a video [px]; InputError for another layout."""
        poser = Poser(model)
        people = list(self.people(path, poser, image_size))
        return merge_people(self.world, people, poser.notes, poser.image_size)


METHODS: Final = {
    method.name: method
    for method in (
        Method("hybrik", "HybrIK", "camera", methods.read_hybrik),
        Method("4dhumans", "4DHumans", "camera", methods.read_humans4d),
        Method("glamr", "GLAMR", "shared", methods.read_glamr),
        *(
            Method(f"slahmr{name}", title, "shared", partial(methods.read_slahmr, phase=phase))
            for name, title, phase in (
                ("", "SLAHMR", "motion_chunks"),
                ("-true-cameras", "SLAHMR w/ GT cameras", "motion_chunks"),
                ("-no-humor", "SLAHMR w/o HuMoR", "smooth_fit"),
            )
        ),
        Method("wham", "WHAM", "own", methods.read_wham),
        Method("gvhmr", "GVHMR", "own", methods.read_gvhmr),
        Method("tram", "TRAM", "shared", methods.read_tram),
        Method("prompthmr", "PromptHMR", "shared", methods.read_prompthmr),
        Method("smpl", "SMPL file", "shared", methods.read_smpl),
    )
}
"""By name, in the order of the paper's table."""


def find_method(name: str) -> Method:
    """Return a method by its name; UsageError if none has it."""
    if name not in METHODS:
        todo = "Name the method as NAME=PATH."
        raise UsageError(f"--method {name}", f"one of {', '.join(METHODS)}", repr(name), todo)
    return METHODS[name]
