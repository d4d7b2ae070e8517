"""The generated documents in docs/schemas are those of the code."""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from pydantic import ValidationError

from data_contracts.arrays import CHUNK_BYTES, array_layout
from data_contracts.match import MatchSpec
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
