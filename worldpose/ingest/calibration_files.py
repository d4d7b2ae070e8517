"""Readers of calibrated cameras from files of other tools."""

from __future__ import annotations

from pathlib import Path

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.ingest.calibration_qualisys import read_calibration_qualisys
from worldpose.ingest.calibration_toml import read_calibration_toml, write_calibration_toml

__all__ = ["read_calibration", "write_calibration_toml"]


def read_calibration(path: Path) -> dict[str, CameraCalibration]:
    """Return the cameras of a calibration file by name, in file order.

    Args:
        path: `.toml` of Anipose, Pose2Sim or caliscope (see `calibration_toml`); `.txt` or `.xml`
            of Qualisys (see `calibration_qualisys`).

    Raises:
        InputError: an unknown file type, or an invalid entry, with file and key.
    """
    if path.suffix.lower() == ".toml":
        return read_calibration_toml(path)
    if path.suffix.lower() in (".txt", ".xml"):
        return read_calibration_qualisys(path)
    raise InputError(
        str(path),
        expected="a calibration: .toml (Anipose, Pose2Sim, caliscope) or .qca.txt (Qualisys)",
        found=f"a file that ends in {path.suffix!r}",
        todo="Export the calibration in one of these forms.",
    )
