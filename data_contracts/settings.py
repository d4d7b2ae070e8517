"""Layers of settings: what a project, a venue and a match state, for all of their runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from data_contracts.cameras import LensCalibration
from data_contracts.match import Side, one_error
from data_contracts.pitch import PitchSpec
from data_contracts.records import Name
from data_contracts.release import EXPORT_PURPOSES
from data_contracts.run import GatePolicy
from data_contracts.usability import UsableLimits

IterationCount = Annotated[
    Annotated[int, Field(ge=1, le=1000)] | Literal["auto"],
    one_error("iterations", "a number from 1 to 1000, or auto"),
]
"""Number of iterations; auto = until an iteration brings no improvement."""


def _absolute(folder: str) -> str:
    if not Path(folder).expanduser().is_absolute():
        raise ValueError(f"the relative path {folder!r}; every door needs the whole path")
    return folder


def _known(name: str) -> str:
    if name not in EXPORT_PURPOSES:
        raise ValueError(f"{name}; the formats are {', '.join(EXPORT_PURPOSES)}")
    return name


Folder = Annotated[str, AfterValidator(_absolute)]
"""Path of a folder, absolute or from the home folder (`~`)."""


class RunSettings(UsableLimits):
    """The settings of a layer that are not of a stage; those of stages are named `stage.name`."""

    venue: Name | None = None
    """The venue of a match, in the layer of the match; else that of match.yaml."""
    iterations: IterationCount = 1
    """Number of iterations of a run of the whole method, or auto."""
    gates: GatePolicy | None = None
    """When results need review; by default never for commands, and auto in a served project."""
    body_folder: Folder | None = None
    """Folder of installed bodies; by default that of WORLDPOSE_BODY_FOLDER, or else the user's."""
    exports: tuple[Annotated[str, AfterValidator(_known)], ...] = ()
    """Formats that are exported after each run that has results, as in exports=["joints"]."""
    exports_folder: Folder | None = None
    """Folder of these exports, one folder in it per match; by default `exports` of the project."""
    pitch: PitchSpec | None = None
    """The pitch of matches without a pitch of their own, as in pitch={"template": "football"}."""
    lenses: tuple[LensCalibration, ...] = ()
    """Lenses of static cameras, by their id, that neither lenses.toml nor calibration.toml has."""
    sides: dict[Name, Side] = {}
    """Camera to its side, where match.yaml states none, as in sides={"cam1": "left"}."""
