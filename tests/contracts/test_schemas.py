"""The generated documents in docs/schemas are those of the code."""

import importlib
import json
import pkgutil
import typing
from pathlib import Path

import annotated_types
import jsonschema
import numpy as np
import pytest
from pydantic import ValidationError
from run_records import match_spec

import data_contracts
import worldpose
from data_contracts.arrays import CHUNK_BYTES, array_layout
from data_contracts.match import MatchSpec, PlayerSpec
from data_contracts.records import Record
from data_contracts.schemas import LAYOUTS, documents

FOLDER = Path(__file__).parents[2] / "docs" / "schemas"


def test_schemas_on_disk_match_the_contracts():
    on_disk = {path.name: json.loads(path.read_text()) for path in FOLDER.glob("*.json")}
    assert on_disk == json.loads(json.dumps(documents())), "run: make schemas"


def test_match_schema_accepts_what_the_record_accepts_and_refuses_unknown_keys():
    schema = json.loads((FOLDER / "match.schema.json").read_text())
    match = {
        "match_id": "m",
        "fps": 25,
        "cameras": [{"id": "a", "width": 10, "height": 10}],
        "clips": [{"id": "c", "frame_count": 3}],
    }
    jsonschema.validate(match, schema)
    MatchSpec.model_validate(match)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(match | {"framerate": 25}, schema)
    with pytest.raises(ValidationError):
        MatchSpec.model_validate(match | {"framerate": 25})


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.stage)
def test_layouts_are_complete(layout):
    names = [array.name for array in (*layout.coordinates, *layout.arrays)]
    assert len(names) == len(set(names))
    assert set(layout.optional) <= {*names, *layout.attributes}
    for array in (*layout.coordinates, *layout.arrays):
        assert len(array.dims) == len(set(array.dims)), "labelled arrays need distinct dimensions"
        assert array.chunk_dim is None or array.chunk_dim in array.dims
        assert (array.missing == "nan") <= array.dtype.startswith("float")


def test_chunks_hold_a_mebibyte_or_the_whole_array():
    layout = array_layout(
        "joints", "(*frame, person, joint, coordinate) float64 [m], missing nan", ""
    )
    # One frame of 22 people: 22 * 17 * 3 * 8 = 8976 bytes, so 117 frames make a mebibyte.
    assert layout.chunks((3000, 22, 17, 3)) == (117, 22, 17, 3)
    assert np.prod(layout.chunks((3000, 22, 17, 3))) * 8 >= CHUNK_BYTES
    assert layout.chunks((10, 22, 17, 3)) == (10, 22, 17, 3)
    assert layout.chunks((0, 0, 17, 3)) == (1, 1, 17, 3)


def roster(red, blue, officials):
    return (
        *(PlayerSpec(id=f"r{n}", team="red") for n in range(red)),
        *(PlayerSpec(id=f"b{n}", team="blue") for n in range(blue)),
        *(PlayerSpec(id=f"o{n}", role="official") for n in range(officials)),
    )


@pytest.mark.parametrize(
    ("people", "limit"),
    [((11, 11, 3), 25), ((16, 18, 1), 23), ((11, 11, 0), None), ((11, 5, 3), None)],
)
def test_eleven_of_each_team_and_the_officials_are_allowed_if_all_are_named(people, limit):
    assert match_spec(["left"], roster=roster(*people)).max_people == limit


MEASURED = {"figures"}
"""Fields with whatever was measured, in any unit; nothing reads them back to compute."""
VERSION = {"contract"}


def stated_records():
    """Yield every record of `data_contracts`, and all settings of the library."""
    names = [m.name for m in pkgutil.walk_packages(data_contracts.__path__, "data_contracts.")]
    found = pkgutil.walk_packages(worldpose.__path__, "worldpose.", onerror=lambda _: None)
    names += [m.name for m in found if m.name.endswith("settings")]
    for name in sorted(names):
        module = importlib.import_module(name)
        for value in vars(module).values():
            if isinstance(value, type) and issubclass(value, Record) and value.__module__ == name:
                yield value


def unbounded(annotation, metadata):
    """Return whether a number within an annotation lacks a lower or an upper bound."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        inner, *own = typing.get_args(annotation)
        return unbounded(inner, [*metadata, *own])
    if annotation in (int, float):
        rules = list(annotated_rules(metadata))
        low = any(isinstance(rule, annotated_types.Ge | annotated_types.Gt) for rule in rules)
        high = any(isinstance(rule, annotated_types.Le | annotated_types.Lt) for rule in rules)
        return not (low and high)
    if origin is typing.Literal:
        return False
    return any(unbounded(each, metadata) for each in typing.get_args(annotation))


def annotated_rules(metadata):
    for rule in metadata:
        if hasattr(rule, "metadata"):
            yield from annotated_rules(rule.metadata)
        elif isinstance(rule, annotated_types.GroupedMetadata):
            yield from rule
        else:
            yield rule


def test_every_number_that_is_stated_has_both_bounds():
    records = list(stated_records())
    assert len(records) > 80
    lacking = [
        f"{record.__module__}.{record.__name__}.{name}"
        for record in records
        for name, field in record.model_fields.items()
        if name not in MEASURED | VERSION and unbounded(field.annotation, field.metadata)
    ]
    assert not lacking
