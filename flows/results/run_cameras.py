"""The cameras of a run, static and by broadcast view, and the pitch that they show."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from data_contracts.arrays import Integers
from data_contracts.match import MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.triangulation import CameraChange
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.geometry.lens_fit import fit_brown_lens
from worldpose.geometry.lens_models import LensModel
from worldpose.static_calibration.venue import Venue, join_cameras
from worldpose.store.store import Run

ADJUSTED = "bundle_adjustment/cameras"
BROADCAST = "broadcast_calibration/"
Lens = dict[str, str | float | None]
"""Model and errors of a lens."""
TRIANGULATED = ("retriangulation", "triangulation")
"""Stages that place joints and find how cameras change within a clip, the best first."""


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


def view_changes(run: Run, clip: str, stage: str | None = None) -> list[CameraChange]:
    """Return how views of static cameras change within a clip, as `stage` or the best one found."""
    names = (f"{each}/{clip}" for each in TRIANGULATED[stage == "triangulation" :])
    stated = next((run[name].attrs["changes"] for name in names if name in run), ())
    return [each for each in map(CameraChange.model_validate, stated) if each.kind == "view"]


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


def static_cameras(run: Run, spec: MatchSpec, stage: str | None = None) -> dict[str, Camera]:
    """Return the static cameras of a run by id; if it has joints, all that it did not leave out.

    They are those with which `stage` computed joints, or the best available.
    """
    if ADJUSTED in run and stage != "triangulation":
        adjusted = run[ADJUSTED]
        cameras = camera_from_arrays(adjusted.data_vars)
        return {str(name): cameras[c] for c, name in enumerate(adjusted["camera"].values)}
    venue, camera_ids = _join_calibrated(run, spec)
    if venue is None:
        return {}
    return {camera_id: venue.cameras[index] for index, camera_id in enumerate(camera_ids)}


def with_brown_lenses(
    cameras: Mapping[str, Camera], where: str
) -> tuple[dict[str, Camera], dict[str, dict[str, str | float | None]]]:
    """Return cameras with Brown's lenses, and the errors of those that had another, by id.

    InputError, with `where` as what is written, if Brown's model does not follow a lens.
    """
    found, errors = dict(cameras), dict[str, dict[str, str | float | None]]()
    for name, camera in cameras.items():
        if camera.lens_model != LensModel.BROWN:
            found[name], off = fit_brown_lens(camera, f"{where}: {name}")
            errors[name] = {"lens_model": LensModel(int(camera.lens_model)).label, **off}
    return found, errors


def followed_lenses(
    given: Mapping[str, Camera], where: str
) -> tuple[dict[str, Camera], dict[str, Lens]]:
    """Return static cameras with Brown's lenses, and errors of those that had another, by id.

    A camera whose lens Brown's model cannot follow is left out, with the reason.
    """
    cameras, errors = dict[str, Camera](), dict[str, Lens]()
    for name, camera in given.items():
        try:
            own, off = with_brown_lenses({name: camera}, where)
        except InputError as error:
            model = LensModel(int(camera.lens_model)).label
            errors[name] = {"lens_model": model, "max_error_px": None, "reason": str(error)}
        else:
            cameras, errors = cameras | own, errors | off
    return cameras, errors


def _join_calibrated(run: Run, spec: MatchSpec) -> tuple[Venue | None, list[str]]:
    """Return the calibrated static cameras that a run did not leave out, and their ids."""
    found = {
        camera.id: run[unit].data_vars
        for camera in spec.static_cameras
        if camera.id not in run.record.left_out
        and (unit := f"static_calibration/{camera.id}") in run
    }
    return (join_cameras(list(found.values())) if found else None), list(found)


def estimated_pitch(
    run: Run, pitch: PitchSpec | None, spec: MatchSpec, clip: str | None = None
) -> PitchSpec | None:
    """Return the pitch with the surface that a run estimated, for drawing; None without a pitch.

    The pitch is that of the clip's (or the view's) broadcast camera that knows it best, if one
    estimated it; otherwise crown and end fall are those that the static cameras show together.
    """
    if pitch is None:
        return None
    views = [] if clip is None else broadcast_views(run, clip)
    stated = (run[f"{BROADCAST}{view}"].attrs["pitch"] for view in views)
    if estimated := [each for each in stated if each is not None]:
        found = min(estimated, key=lambda each: sum(each["std_m"]))
        names = ("length", "width", "crown", "end_fall", "points")
        sizes = {name: found[name] for name in names if name in found}
        given = pitch.model_dump(mode="json") | sizes
        return PitchSpec.model_validate(given | {"any_size": True})
    if ADJUSTED in run:
        surface = run[ADJUSTED].attrs["surface"]
    else:
        venue, _ = _join_calibrated(run, spec)
        shown = None if venue is None else venue.surface
        surface = None if shown is None else shown.shape.tolist()
    if surface is None:
        return pitch
    # Not validated: an estimated crown may be slightly negative.
    return pitch.model_copy(update={"crown": surface[0], "end_fall": surface[1]})
