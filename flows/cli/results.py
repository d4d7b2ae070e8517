"""Commands export and report: output of results."""

from __future__ import annotations

import inspect
import json
from glob import escape
from pathlib import Path
from typing import Annotated, Literal

import typer

from data_contracts.release import EXPORT_FORMATS, EXPORT_PURPOSES
from flows.cli.console import answer, errors, line
from worldpose.errors import InputError, UsageError
from worldpose.store.runs import LATEST
from worldpose.store.store import Store


def export(
    store: Store,
    match: str,
    forms: Annotated[
        list[str],
        typer.Option(
            "--format",
            metavar="NAME",
            help=f"{', '.join(EXPORT_FORMATS[:-1])} or {EXPORT_FORMATS[-1]} "
            "(docs/reference/formats.md); more than one may be given.",
        ),
    ],
    out: Path,
    run: str = "latest",
    stage: str | None = None,
    definition: Literal["body", "detector"] | None = None,
    release: Annotated[str | None, typer.Option(metavar="NAME")] = None,
    licence: Path | None = None,
    filled: bool = False,
    surface: bool = False,
    video: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a run's results as files that other tools read.

    Files of an earlier export of the same match are replaced, those of another match are not.

    Example: worldpose export tiny-1 --format joints --out exported

    Options:
        out: Output folder; with --format viewer also FILE.html.
        definition: Joints where the detector sees them, but wrists and ankles where the body model
            has them (by default); or all where the model has them (always in a release).
        release: Freeze the run under this name.
        licence: Text of the data licence, for a release or the files.
        filled: Interpolate and flag joints that are missing for a while.
        surface: With gltf, also write the surface of a licensed body model (needs --licence).
        video: With viewer, also embed the clip's overlay video.
    """
    from flows.registering import find_registration, open_match
    from flows.results.best_results import Origin, describe_age, open_results
    from flows.results.export import export as export_formats
    from flows.results.export import release as write_release
    from flows.results.export import require_formats
    from flows.review.identities import lost_names
    from worldpose.dataset.manifest import LENS_ERRORS

    require_formats(forms, stage)
    changed = "--filled" if filled else "--definition detector"
    if release is not None and (licence is None or filled or definition == "detector"):
        raise UsageError(
            "worldpose export --release",
            expected="--licence FILE, no --filled, no --definition detector: joints as computed",
            found="no licence" if licence is None else changed,
            todo="Give the text of the data licence, or export without --release.",
        )
    if video and "viewer" not in forms:
        raise UsageError(
            "worldpose export --video",
            expected="--format viewer, whose file holds the video",
            found=f"--format {' --format '.join(forms)}",
            todo="Add --format viewer, or leave out --video.",
        )
    registration = find_registration(store, match)
    name = registration.spec.match_id
    opened = open_results(store, name, run)
    if run == LATEST and (later := describe_age(store, opened.record)):
        line(later, to=errors)
    for text in opened.record.usability.reservations:
        line(f"reservation: {text}", to=errors)
    for text in lost_names(opened).values():
        line(f"warning: {text}", to=errors)
    origin = Origin(
        opened,
        registration,
        stage,
        filled=filled,
        surface=surface,
        definition=definition or "detector",
        footage=(store, open_match(store, name)) if video else None,
        licence=None if licence is None else read_licence(licence),
    )
    if release is None or origin.licence is None:
        written = export_formats(origin, forms, out, overwrite=overwrite)
    else:
        written = write_release(store, origin, forms, out, release, origin.licence)
    sizes = {
        path: f", {path.stat().st_size / 1e6:.1f} MB" for path in written if path.suffix == ".html"
    }
    off = []
    for path in (path for path in written if path.name == LENS_ERRORS):
        for camera, each in json.loads(path.read_text()).items():
            most, beyond = each["max_error_px"], each["max_error_beyond_px"]
            off.append(f"lens of {camera} in cameras/: up to {most:.2g} px off the one used")
            if beyond != 0.0:
                more = "the lens folds" if beyond is None else f"up to {beyond:.2g} px"
                off[-1] += f"; {more} beyond {each['fitted_angle_deg']:.0f} degrees"
    told = (f"wrote {path}{sizes.get(path, '')}" for path in written)
    answer({"match": name, "files": [str(path) for path in written]}, *told, *off)


def read_licence(file: Path) -> str:
    """Return the text of a data licence."""
    try:
        text = file.read_text(encoding="utf-8-sig").strip()
    except (OSError, ValueError) as error:
        text, found = "", str(error)
    else:
        found = "nothing"
    if not text:
        raise InputError(
            f"--licence {file}",
            expected="the text of the data licence, in UTF-8",
            found=found,
            todo="Give a text file.",
        )
    return text


_LISTED = "\n".join(f"  {name:15} {purpose}" for name, purpose in EXPORT_PURPOSES.items())
# Click keeps the lines of a paragraph that begins with this sign.
_ABOUT, _, _OPTIONS = (inspect.getdoc(export) or "").partition("\n\nOptions:")
export.__doc__ = f"{_ABOUT}\n\n\b\nFormats:\n{_LISTED}\n\nOptions:{_OPTIONS}"


def report(
    store: Store,
    match: str,
    out: Path = Path("report.html"),
    reference: str | None = None,
    videos: bool = True,
    camera: str | None = None,
    figures: Annotated[Path | None, typer.Option(metavar="FOLDER")] = None,
    run: str = "latest",
    overwrite: bool = False,
) -> None:
    """Write one HTML page about a run, with its settings, metrics and images.

    Example: worldpose report tiny-1 --out report.html

    Options:
        out: Output page.
        reference: Ground truth; reference/ of the match by default.
        videos: Also write videos with overlaid markings and bodies.
        camera: Static camera of a video; the one with most people by default.
        figures: Also write the page's figures as SVG and PDF, with their data as JSON.
    """
    from flows.registering import find_match, open_stored
    from flows.reports.report import write_report
    from flows.results.best_results import describe_age, open_results
    from flows.results.outputs import record_owner, require_own

    try:
        known = find_match(store, match, unfinished=True)
    except InputError as error:
        try:
            known = open_stored(store, match)
        except InputError:  # it is not registered: the first error says why
            raise error from None
        there = known.folder.videos or known.folder.clicked
        what = "is of the registered folder" if there else "has no images"
        open_results(store, known.match_id, run)  # without a run, that alone is said
        line(f"warning: the report {what}: {error}", to=errors)
    clips = [clip.id for clip in known.folder.spec.clips] if videos else []
    films = [f for c in clips for f in out.parent.glob(f"{escape(out.stem)}-{c}*.mp4")]
    places = {out.parent: [out, *films]}
    if figures is not None:
        places[figures] = [*places.get(figures, ()), *figures.glob("[0-9][0-9]-*.*")]
    for place, files in places.items():
        names = {file.name: None for file in files}
        require_own(place, names, (known.match_id,), overwrite=overwrite)
    opened = open_results(store, known.match_id, run).record
    if run == LATEST and (later := describe_age(store, opened)):
        line(later, to=errors)
    films, unscored = write_report(
        store,
        known,
        out,
        run_id=opened.run_id,
        reference=reference,
        videos=videos,
        camera=camera,
        figures=figures,
    )
    if unscored:
        line(f"warning: {unscored}", to=errors)
    written_files = {file.name: None for file in (out, *films)}
    record_owner(out.parent, written_files, known.match_id)
    if figures is not None:
        names = {file.name: None for file in figures.glob("[0-9][0-9]-*.*")}
        record_owner(figures, names, known.match_id)
    written = {"report": str(out.resolve()), "videos": [str(film.resolve()) for film in films]}
    folder = {} if figures is None else {"figures": str(figures.resolve())}
    answer(
        {"match": known.match_id, **written, **folder},
        f"report:  {out.resolve()}",
        *(f"video:   {film.resolve()}" for film in films),
        *(f"figures: {place}" for place in folder.values()),
        f"results: {store.url}/results/{known.match_id}",
    )
