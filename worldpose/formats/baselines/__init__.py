"""Baseline methods: readers for the results of other methods on one clip.

Inputs: the files that a method's own code wrote, and the body model for its poses. Outputs:
    `MethodResult`: joints, their world frame, boxes in the image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from worldpose.body.model import BodyModel
from worldpose.errors import UsageError
from worldpose.formats.baselines.camera_methods import read_humans4d, read_hybrik
from worldpose.formats.baselines.result import MethodResult, resample_result
from worldpose.formats.baselines.world_methods import (
    WITH_MOTION_PRIOR,
    WITHOUT_MOTION_PRIOR,
    make_slahmr_reader,
    read_glamr,
    read_gvhmr,
    read_prompthmr,
    read_smpl,
    read_tram,
    read_wham,
)

__all__ = ["METHODS", "Method", "MethodResult", "find_method", "resample_result"]


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
        Method("slahmr", "SLAHMR", make_slahmr_reader(WITH_MOTION_PRIOR)),
        Method(
            "slahmr-true-cameras", "SLAHMR w/ GT cameras", make_slahmr_reader(WITH_MOTION_PRIOR)
        ),
        Method("slahmr-no-humor", "SLAHMR w/o HuMoR", make_slahmr_reader(WITHOUT_MOTION_PRIOR)),
        Method("wham", "WHAM", read_wham),
        Method("gvhmr", "GVHMR", read_gvhmr),
        Method("tram", "TRAM", read_tram),
        Method("prompthmr", "PromptHMR", read_prompthmr),
        Method("smpl", "SMPL file", read_smpl),
    )
}
"""By name, in the order of the paper's table (E5)."""


def find_method(name: str) -> Method:
    """Return a method by its name.

    Raises:
        UsageError: no method has this name.
    """
    if name not in METHODS:
        raise UsageError(
            f"--method {name}",
            expected=f"one of {', '.join(METHODS)}",
            found=repr(name),
            todo="Name the method as NAME=PATH.",
        )
    return METHODS[name]
