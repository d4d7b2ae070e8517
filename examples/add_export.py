"""Add an export: the ways of all people over the pitch, as GeoJSON lines in metres.

    worldpose run match
    python examples/add_export.py worldpose-data tiny-1-1s out

An export is a function of a run, `Origin`, and of a folder. It yields the files that it wrote.
CONTRIBUTING.md: how `worldpose export --format` offers it to everybody.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import worldpose as wp
from flows.results.best_results import Origin
from flows.results.export import EXPORTS, export
from worldpose.store.store import Store

HIPS = slice(11, 13)


def export_ways(origin: Origin, out: Path) -> Iterator[Path]:
    """Write `<clip>.geojson`: a line per person through the mid-hips [m], with its frames."""
    for clip in origin.clips:
        tracks, features = origin.tracks(clip), []
        for index, person in enumerate(tracks.person_ids.tolist()):
            way = tracks.joints[:, index, HIPS, :2].mean(axis=1)
            seen = np.isfinite(way).all(axis=1)
            line = {"type": "LineString", "coordinates": way[seen].round(3).tolist()}
            about = {"person": person, "frames": tracks.frames[seen].tolist()}
            features.append({"type": "Feature", "geometry": line, "properties": about})
        path = out / f"{clip}.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
        yield path


if __name__ == "__main__":
    project, match, folder = sys.argv[1:]
    EXPORTS["ways"] = export_ways
    registration = Store.open(project).registration(match)
    origin = Origin(wp.open_run(project, match), registration)  # type: ignore[arg-type] # it ran
    print(*export(origin, ["ways"], Path(folder)), sep="\n")
