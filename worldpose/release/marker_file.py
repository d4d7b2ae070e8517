"""A person's joints as markers in a TRC file, which OpenSim and motion capture tools read."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from worldpose.release.files import whole_file
from worldpose.release.joints_file import JointTracks

Y_UP: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Takes world points into the axes of OpenSim and of animation tools: x stays, y is up."""
MILLIMETRES: Final = 1000.0
"""In a metre: TRC files are in millimetres, and say so."""
DECIMALS: Final = 3
"""Of all coordinates: a micrometre."""


def write_markers(path: Path, tracks: JointTracks, person: int, fps: float) -> None:
    """Write the joints of one person as a TRC file, whole or not at all.

    Rows go from the first to the last frame in which the person has a joint, none left out; a
    missing joint has empty cells. `Frame#` is the match frame plus one, as such files count from
    one, and `Time` is that of the match frame [s]. Coordinates are y up, in millimetres.

    Args:
        path: the file.
        tracks: joints of several people.
        person: place of the person in `tracks`.
        fps: frames in a second.
    """
    first, markers = _rows(tracks, person)
    count = len(COCO17)
    values = markers.reshape(len(markers), 3 * count)
    cells = np.char.mod(f"%.{DECIMALS}f", values)
    cells[np.isnan(values)] = ""
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"
        "\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{fps:g}\t{fps:g}\t{len(markers)}\t{count}\tmm\t{fps:g}\t1\t{len(markers)}",
        "Frame#\tTime\t" + "\t\t\t".join(COCO17) + "\t\t",
        "\t\t" + "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, count + 1)),
        "",
    ]
    for frame, row in enumerate(cells.tolist(), start=first):
        lines.append("\t".join([str(frame + 1), f"{frame / fps:.6f}", *row]))
    with whole_file(path) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rows(tracks: JointTracks, person: int) -> tuple[int, NDArray[np.float64]]:
    """The first match frame, and markers (frames, 17, 3) [mm, y up] of every frame from there."""
    seen = np.flatnonzero(np.isfinite(tracks.joints[:, person]).any((-1, -2)))
    if not len(seen):
        return 0, np.empty((0, len(COCO17), 3))
    numbers = tracks.frames[seen]
    first = int(numbers[0])
    markers = np.full((int(numbers[-1]) - first + 1, len(COCO17), 3), np.nan)
    markers[numbers - first] = tracks.joints[seen, person] @ Y_UP.T * MILLIMETRES
    return first, markers
