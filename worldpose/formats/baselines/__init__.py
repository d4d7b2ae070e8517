"""Baseline methods: readers for the results of other methods on one clip.

Inputs: the files that a method's own code wrote, and the body model for its poses. Outputs:
    `MethodResult`: joints, their world frame, boxes in the image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from worldpose.body.model import BodyModel
from worldpose.errors import UsageError
from worldpose.formats.baselines.camera_methods import read_humans4d, read_hybrik
from worldpose.formats.baselines.result import MethodResult
from worldpose.formats.baselines.world_methods import (
    read_glamr,
    read_gvhmr,
    read_prompthmr,
    read_slahmr,
    read_smpl,
    read_tram,
    read_wham,
)


@dataclass(frozen=True)
class Method:
    """A supported baseline method."""

    name: str
    """Name on the command line."""
    title: str
    """Name in tables."""
    read: Callable[[Path, BodyModel, tuple[int, int]], MethodResult]
    """Takes path, body and the video's width and height [px]."""


METHODS: Final = {
    method.name: method
    for method in (
        Method("hybrik", "HybrIK", read_hybrik),
        Method("4dhumans", "4DHumans", read_humans4d),
        Method("glamr", "GLAMR", read_glamr),
        Method("slahmr", "SLAHMR", partial(read_slahmr, phase="motion_chunks")),
        Method(
            "slahmr-true-cameras",
            "SLAHMR w/ GT cameras",
            partial(read_slahmr, phase="motion_chunks"),
        ),
        Method("slahmr-no-humor", "SLAHMR w/o HuMoR", partial(read_slahmr, phase="smooth_fit")),
        Method("wham", "WHAM", read_wham),
        Method("gvhmr", "GVHMR", read_gvhmr),
        Method("tram", "TRAM", read_tram),
        Method("prompthmr", "PromptHMR", read_prompthmr),
        Method("smpl", "SMPL file", read_smpl),
    )
}
"""By name, in the order of the paper's table."""


def find_method(name: str) -> Method:
    """Return a method by its name.

    Raises:
        UsageError: no method has this name.
    """
    if name not in METHODS:
        todo = "Name the method as NAME=PATH."
        raise UsageError(f"--method {name}", f"one of {', '.join(METHODS)}", repr(name), todo)
    return METHODS[name]
