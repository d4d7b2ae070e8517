"""Prints cameras from single key frames of real main cameras: hand-drawn lines of WorldCup 2014.

    python benchmarks/broadcast_line_sets.py DATA

DATA holds `wc14` (lines.json, calib_eval.py), as for pitch_lines.py. There are no images: every
line set is the only key frame of its clip, whose camera depends on the drawn lines alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pitch_lines
from soccernet import soccernet_markings

from data_contracts.broadcast_calibration import KeyFrame
from worldpose.broadcast_calibration.key_frames import calibrate_keys
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.errors import WorldposeError
from worldpose.geometry.cameras import Camera

_, SIZE = pitch_lines.SETS["wc14"]


def cameras(lines: dict[str, pitch_lines.Lines]) -> dict[str, Camera | None]:
    """Return each line set's camera, that of a clip with this one key frame."""
    settings = BroadcastCalibrationSettings()
    found: dict[str, Camera | None] = {}
    for name, drawn in lines.items():
        key = KeyFrame(frame=0, markings=soccernet_markings(drawn, SIZE))
        try:
            keys = calibrate_keys(pitch_lines.PITCH, [key], SIZE, {}, settings, name)
        except WorldposeError:
            found[name] = None
        else:
            found[name] = keys.camera.camera[0]
    return found


def line_sets(folder: Path, count: int = 30) -> dict[str, pitch_lines.Lines]:
    """Return line sets of the half that settings were not tuned on."""
    return dict(list(pitch_lines.load_lines(folder, "wc14", 1, 1).items())[:count])


def main() -> None:
    """Print the number of cameras, their positions, and their residuals on the drawn lines."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    options = parser.parse_args()
    lines, scorer = line_sets(options.data), pitch_lines.load_scorer(options.data)
    found = {name: each for name, each in cameras(lines).items() if each is not None}
    hits = [pitch_lines.jaccards(scorer, lines[name], each, SIZE) for name, each in found.items()]
    centers = np.array([each.center for each in found.values()])
    away = np.hypot(centers[:, 0], centers[:, 1])
    print(f"{len(found)} of {len(lines)} line sets give a camera")
    print(f"from the pitch's centre {away.min():.1f} to {away.max():.1f} m")
    print(f"height {centers[:, 2].min():.1f} to {centers[:, 2].max():.1f} m")
    shares = " / ".join(f"{each:.1f}" for each in 100.0 * np.mean(hits, axis=0))
    print(f"JaC@5 / @10 / @20: {shares} %")


if __name__ == "__main__":
    main()
