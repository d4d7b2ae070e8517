"""Supported baseline methods, with their names in the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from worldpose.baselines.glamr import read_glamr
from worldpose.baselines.gvhmr import read_gvhmr
from worldpose.baselines.humans4d import read_humans4d
from worldpose.baselines.hybrik import read_hybrik
from worldpose.baselines.prompthmr import read_prompthmr
from worldpose.baselines.result import MethodResult
from worldpose.baselines.slahmr import WITH_MOTION_PRIOR, WITHOUT_MOTION_PRIOR, slahmr_reader
from worldpose.baselines.smpl_file import read_smpl
from worldpose.baselines.tram import read_tram
from worldpose.baselines.wham import read_wham
from worldpose.body import BodyModel
from worldpose.errors import UsageError


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
        Method("slahmr", "SLAHMR", slahmr_reader(WITH_MOTION_PRIOR)),
        Method("slahmr-true-cameras", "SLAHMR w/ GT cameras", slahmr_reader(WITH_MOTION_PRIOR)),
        Method("slahmr-no-humor", "SLAHMR w/o HuMoR", slahmr_reader(WITHOUT_MOTION_PRIOR)),
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
        UsageError: there is none of this name.
    """
    if name not in METHODS:
        raise UsageError(
            f"--method {name}",
            expected=f"one of {', '.join(METHODS)}",
            found=repr(name),
            todo="Name the method as NAME=PATH.",
        )
    return METHODS[name]
