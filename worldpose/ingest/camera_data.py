"""Import of a broadcast camera's data, as a tracking system recorded them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from worldpose.errors import InputError, UsageError, unknown_name
from worldpose.formats.camera_data import (
    CameraData,
    apply_zoom_table,
    read_camera_data,
    write_camera_data,
)
from worldpose.formats.files import whole_file
from worldpose.ingest.footage import footage_size, image_clock
from worldpose.ingest.match_folder import MatchFolder, camera_data_file, read_match


def read_given_camera(
    match: MatchFolder, view: str, file: Path, first: int | None = None, number: int = -1
) -> CameraData:
    """Return the camera data of a broadcast view; arguments as in `read_camera_data`."""
    fps = match.spec.fps * image_clock(match.spec, view).rate
    return read_camera_data(file, fps, footage_size(match.spec, view), first, number=number)


def import_camera_data(
    file: Path,
    folder: Path,
    view: str | None = None,
    *,
    first: int | None = None,
    number: int | None = None,
    zoom_table: Path | None = None,
) -> tuple[Path, CameraData]:
    """Write the camera data of `file` into a match folder, and return the new file and its content.

    `view` None is the only broadcast view; `first` is the number in its video of the file's first
    frame; None = as the file says. `number` is FreeD's of the camera, None = the only one, and
    `zoom_table` has the lens's focal lengths by zoom counts. InputError if the file has no frame of
    the view, or the view has camera data already.
    """
    match = read_match(folder, whose=None)
    views = match.spec.broadcast_views
    if view is None and len(views) == 1:
        (view,) = views
    if view not in views:
        raise unknown_name(f"--camera {view}", str(view), views, "Name one of the clips.")
    target = folder / camera_data_file(view)
    if target.exists():
        raise UsageError(str(target), expected="no file yet", found="one", todo="Remove it first.")
    data = read_given_camera(match, view, file, first, -1 if number is None else number)
    if zoom_table is not None:
        data = apply_zoom_table(data, zoom_table, footage_size(match.spec, view))
    images = image_clock(match.spec, view).images
    missing = int((~np.isin(images, data.frame)).sum())
    if missing == len(images):
        expected = f"frames {images[0]} to {images[-1]} of the video of {view}"
        todo = "State the video's frame of the first row: --first-frame NUMBER."
        raise InputError(str(file), expected, f"frames {data.frame[0]} to {data.frame[-1]}", todo)
    if missing:
        note = f"{missing} of {len(images)} images of {view} have no camera data"
        data = replace(data, notes=(*data.notes, note))
    target.parent.mkdir(exist_ok=True)
    with whole_file(target) as draft:
        write_camera_data(draft, data)
    return target, data
