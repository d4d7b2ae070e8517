"""The moving cameras of a run, by broadcast view."""

from __future__ import annotations

from collections.abc import Collection

from data_contracts.arrays import Integers
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.store.store import Run

BROADCAST = "broadcast_calibration/"


def broadcast_views(run: Run, clip: str | None = None) -> list[str]:
    """Return the broadcast views whose camera a run calibrated, of one clip or view if given."""
    views = [name.removeprefix(BROADCAST) for name in run if name.startswith(BROADCAST)]
    return [view for view in views if clip is None or clip in (view, clip_of(run, view))]


def broadcast_cameras(run: Run, clip: str | None = None) -> dict[str, Camera]:
    """Return the cameras (frames,) of `broadcast_views`."""
    units = {view: run[broadcast_unit(run, view)] for view in broadcast_views(run, clip)}
    return {view: camera_from_arrays(unit.data_vars) for view, unit in units.items()}


def clip_of(run: Run, view: str) -> str:
    """Return the clip of a broadcast view with a calibrated camera."""
    return str(run[f"{BROADCAST}{view}"].attrs["clip_id"])


def broadcast_unit(run: Run, view: str) -> str:
    """Return the name of a view's best broadcast camera, as `stage/unit`."""
    pooled = f"broadcast_pooling/{view}"
    return pooled if pooled in run else f"{BROADCAST}{view}"


def camera_in_frames(run: Run, view: str, frames: Integers) -> Camera:
    """Return the camera of a broadcast view in these match frames, NaN where it is unknown."""
    found = run[broadcast_unit(run, view)]
    by_frame = found[["focal", "principal_point", "distortion", "rotation", "translation"]]
    arrays = by_frame.reindex(frame=frames).data_vars
    return camera_from_arrays({**arrays, "image_size": found["image_size"]})


def moving_cameras(
    run: Run, clip: str, frames: Integers, static: Collection[str] = ()
) -> dict[str, Camera]:
    """Return the moving cameras of a clip in these frames: by view, `broadcast` if alone.

    Where a static camera has that name, the moving one has that of its view.
    """
    views = broadcast_views(run, clip)
    alone = len(views) == 1 and "broadcast" not in static
    names = ["broadcast"] if alone else views
    found = (camera_in_frames(run, view, frames) for view in views)
    return dict(zip(names, found, strict=True))
