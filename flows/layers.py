"""Layers of settings: what a project, its venues and its matches state for all of their runs.

Each layer is a file of the store that maps names to values: `settings/project.yaml`,
`settings/venues/<name>.yaml`, `settings/matches/<id>.yaml`. A name is `stage.setting`, or a field
of `RunSettings`. What a later layer states replaces what an earlier one states; a command line
becomes the layer of its match (`flows.running.settle`). `flows.settings.resolve` is the one place
that turns layers into the settings of a run.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import yaml
from pydantic import JsonValue

from data_contracts.match import MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.settings import RunSettings
from worldpose.body.body_file import given_body_folder
from worldpose.errors import InputError
from worldpose.formats.files import parse_yaml
from worldpose.ingest.match_folder import MatchFolder, image_sizes
from worldpose.ingest.pitch_file import pitch_file, read_pitch
from worldpose.ingest.validation import validate_record
from worldpose.pitch.template import PitchTemplate
from worldpose.store.paths import checked_name, is_name
from worldpose.store.store import Run, Store

PROJECT: Final = "project"
VENUES: Final = "venues"
MATCHES: Final = "matches"
SETTINGS_LOCK: Final = "settings"
"""Lock of a project that is held from reading to writing a layer."""
ENVIRONMENT: Final = "environment"
"""Name of the layer of environment variables, below all others."""


@dataclass(frozen=True)
class Layer:
    """One layer: values by name.

    Attributes:
        name: `project`, `venues/<name>`, `matches/<id>`, `environment`, or `match.yaml`.
        file: file or option that states it, for messages.
        revision: digest of its file; empty without one.
    """

    name: str
    file: str
    values: Mapping[str, JsonValue]
    revision: str = ""

    @property
    def origin(self) -> str:
        """The layer in words, as users know it."""
        kind, _, name = self.name.partition("/")
        return {VENUES: f"venue {name}", MATCHES: "match"}.get(kind, kind)


def match_layer(match_id: str) -> str:
    """Return the name of a match's layer."""
    return f"{MATCHES}/{checked_name(match_id)}"


def read_layer(store: Store, name: str) -> Layer:
    """Return a layer of the store; empty if it has no file.

    InputError unless it maps names to plain values, those that are not of a stage being valid.
    """
    path = layer_path(name)
    file = f"{store.url}/{path}"
    data = store.blobs.read(path)
    if data is None:
        return Layer(name, file, {})
    return Layer(name, file, _parse(name, file, data), hashlib.sha256(data).hexdigest()[:16])


def read_layers(store: Store, spec: MatchSpec) -> tuple[Layer, ...]:
    """Return the layers of a match, the first with the least precedence; see `read_layer`."""
    own = read_layer(store, match_layer(spec.match_id))
    venue = own.values.get("venue", spec.venue)
    named = (
        () if spec.venue is None else (Layer("match.yaml", "match.yaml", {"venue": spec.venue}),)
    )
    at_venue = () if venue is None else (read_layer(store, f"{VENUES}/{venue}"),)
    return (*project_layers(store), *named, *at_venue, own)


def project_layers(store: Store) -> tuple[Layer, ...]:
    """Return the layers that all matches of a project share."""
    folder = given_body_folder()
    here = {} if folder is None else {"body_folder": folder}
    return Layer(ENVIRONMENT, "WORLDPOSE_BODY_FOLDER", here), read_layer(store, PROJECT)


def list_venues(store: Store) -> tuple[str, ...]:
    """Return the names of the venues with a layer, sorted; see `say_unnamed_venues`."""
    return tuple(sorted(filter(is_name, _venue_files(store))))


def say_unnamed_venues(store: Store) -> str:
    """Return what is wrong with venues' files that `list_venues` leaves out for their names."""
    for name in _venue_files(store):
        try:
            checked_name(name)
        except InputError as error:
            return f"{store.url}/settings/{VENUES}/{name}.yaml is not used: {error}"
    return ""


def _venue_files(store: Store) -> list[str]:
    """Return the names of the venues' files without `.yaml`, without hidden files."""
    paths = (entry.path for entry in store.blobs.entries(f"settings/{VENUES}"))
    names = (path.rpartition("/")[2] for path in paths if path.endswith(".yaml"))
    return [name.removesuffix(".yaml") for name in names if not name.startswith(".")]


def write_layer(store: Store, name: str, values: Mapping[str, Any]) -> None:
    """Write all values of a layer; without values its file is removed, unless it is a venue's."""
    if not values and not name.startswith(VENUES):
        store.blobs.delete(layer_path(name))
        return
    plain = json.loads(json.dumps(values, sort_keys=True))  # an object twice would be an alias
    text = yaml.safe_dump(plain, allow_unicode=True)
    about = "# worldpose writes this file, without comments: see worldpose settings --help.\n"
    store.blobs.put(layer_path(name), (about + text).encode())


def merge_general(layers: Iterable[Layer]) -> RunSettings:
    """Return what layers state together besides the settings of stages."""
    merged: dict[str, JsonValue] = {}
    for layer in layers:
        merged |= _split_general(layer.values)
    return RunSettings.model_validate_json(json.dumps(merged))


def add_venue(folder: MatchFolder, layers: Iterable[Layer]) -> MatchFolder:
    """Return a match with the pitch, lenses and sides of its layers where it states none itself.

    InputError if a lens is of another image size than its camera.
    """
    found, spec = merge_general(layers), folder.spec
    if found.pitch is not None and spec.pitch is None and not pitch_file(folder.folder, spec):
        folder = replace(folder, pitch=found.pitch)
    sizes, lenses = image_sizes(spec), dict(folder.lenses)
    for lens in found.lenses:
        if lens.id not in sizes or lens.id in folder.calibrations or lens.id in lenses:
            continue
        if lens.image_size != sizes[lens.id]:
            raise InputError(
                f"settings of {spec.match_id}: lenses: {lens.id}: image_size",
                expected=f"{list(sizes[lens.id])}, as in match.yaml",
                found=str(list(lens.image_size)),
                todo="Calibrate the lens at the size of the videos.",
            )
        lenses[lens.id] = lens
    cameras = tuple(
        each.model_copy(update={"side": found.sides[each.id]})
        if each.side is None and each.id in found.sides
        else each
        for each in spec.cameras
    )
    if cameras != spec.cameras:
        spec = spec.model_copy(update={"cameras": cameras})
    return replace(folder, spec=spec, lenses=lenses)


def pitch_of(store: Store, folder: Path, spec: MatchSpec) -> PitchSpec | None:
    """Return the pitch of a match's folder or else of its layers; None for `pitch: none`."""
    return pitch_in_words(store, folder, spec)[0]


def pitch_in_words(store: Store, folder: Path, spec: MatchSpec) -> tuple[PitchSpec | None, str]:
    """Return the pitch as `pitch_of`, and in words for messages on names that it lacks."""
    if spec.pitch is None and not pitch_file(folder, spec):
        layers = read_layers(store, spec)
        found = merge_general(layers).pitch
        if found is not None:
            origin = [each.origin for each in layers if each.values.get("pitch") is not None][-1]
            return found, f"the {found.template} pitch in the settings of the {origin}"
    return read_pitch(folder, spec), "the pitch"


def known_pitch(store: Store, folder: Path, spec: MatchSpec) -> PitchSpec | None:
    """Return the pitch of a match as `pitch_of`; None if the project lacks its venue."""
    stated = merge_general(read_layers(store, spec))
    is_known = stated.pitch is not None or stated.venue in (None, *list_venues(store))
    return pitch_of(store, folder, spec) if is_known else None


def pitch_of_run(run: Run, otherwise: Callable[[], PitchSpec | None]) -> PitchSpec | None:
    """Return the pitch that a run was computed with: settings can state another one since.

    `otherwise` gives the pitch of a run whose results do not say theirs. Tracks say its size alone.
    """
    for stage in (
        *("static_calibration", "broadcast_calibration", "bundle_adjustment"),
        *("body_fitting", "camera_consistency", "tracking"),
    ):
        for name in (name for name in run if name.startswith(f"{stage}/")):
            place = (run.record.match_id, *name.split("/", 1), run.record.results[name])
            sources = run.manifest(name).recipe.sources if run.store.has(*place) else {}
            if "pitch" in sources:
                stated = sources["pitch"]
                if not isinstance(stated, dict):
                    return None
                found = PitchSpec.model_validate({"any_size": True, **stated})  # checked then
                now = otherwise() if stage == "tracking" else None
                size = {*stated, "dimensions"}
                is_same = now and now.model_dump(include=size) == found.model_dump(include=size)
                return now if is_same else found
    return otherwise()


def layer_path(name: str) -> str:
    """Return the path of a layer in the store."""
    kind, slash, last = name.partition("/")
    return f"settings/{kind}{slash}{checked_name(last) if slash else ''}.yaml"


def _split_general(values: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    return {name: value for name, value in values.items() if "." not in name}


@lru_cache(maxsize=4096)
def _parse(name: str, file: str, data: bytes) -> Mapping[str, JsonValue]:
    try:
        content = parse_yaml(file, data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        content = "bytes that are not UTF-8"
    content = {} if content is None else content
    if not isinstance(content, dict) or not all(isinstance(each, str) for each in content):
        raise InputError(
            file,
            expected="names with values, as in `detection.stride: 2`",
            found=repr(content),
            todo="Correct the file, or write it with worldpose settings --set.",
        )
    check_general(name, file, content)
    return content


def check_general(name: str, file: str, values: Mapping[str, JsonValue]) -> None:
    """Raise InputError for an unknown name or invalid value in a layer that is not of a stage."""
    found = validate_record(RunSettings, _split_general(values), file)
    if found.venue is not None and not name.startswith(MATCHES):
        raise InputError(
            f"{file}: venue",
            expected="a venue in the layer of a match, or in match.yaml",
            found=f"one in the layer of the {name.partition('/')[0]}",
            todo="Remove it here.",
        )
    if found.pitch is not None:
        PitchTemplate.from_spec(found.pitch, where=f"{file}: pitch")
