import math

import pytest

from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.ingest.validation import validate_record


def match(**changes):
    content = {
        "match_id": "final",
        "fps": 25,
        "cameras": [
            {"id": "cam1", "width": 1920, "height": 1080},
            {"id": "cam2", "width": 1920, "height": 1080},
        ],
        "clips": [{"id": "clip", "frame_count": 10}],
    }
    return {key: value for key, value in {**content, **changes}.items() if value is not ...}


def camera(**changes):
    return {"id": "cam2", "width": 1920, "height": 1080, **changes}


def refusal(data, model=MatchSpec):
    with pytest.raises(InputError) as caught:
        validate_record(model, data, "match.yaml")
    return caught.value


def test_plain_data_becomes_the_record():
    spec = validate_record(MatchSpec, match(), "match.yaml")
    assert (spec.fps, spec.cameras[1].id, spec.clips[0].frame_count) == (25.0, "cam2", 10)


FIRST = "match.yaml: cameras[0]"


@pytest.mark.parametrize(
    ("data", "where", "expected", "found", "todo"),
    [
        (match(fps=...), "match.yaml: fps", "a value", "nothing", "Add"),
        (match(fps=-1), "match.yaml: fps", "greater than or equal to 1", "-1", "Correct"),
        (match(fps="25"), "match.yaml: fps", "a valid number", "'25'", "Correct"),
        (match(fps=math.nan), "match.yaml: fps", "a finite number", "nan", "Correct"),
        (match(match_id=12), "match.yaml: match_id", "a valid string", "12", "quotes: '12'"),
        (match(match_id=False), "match.yaml: match_id", "a valid string", "no, off", "'no'"),
        (match(match_id="../x"), "match.yaml: match_id", "letters", "'../x'", "Rename"),
        (match(match_id="a" * 65), "match.yaml: match_id", "64", "aaa...", "Rename"),
        (match(contract=2), "match.yaml: contract", "1", "2", "version of worldpose"),
        (match(cameras={"a": 1}), "match.yaml: cameras", "a valid array", "a mapping", "Correct"),
        (match(cameras=[camera(kind="fixed")]), f"{FIRST}.kind", "'broadcast'", "'fixed'", ""),
        (match(cameras=[camera(id=None)]), f"{FIRST}.id", "a valid string", "nothing", "Correct"),
        (
            match(cameras=[camera(), camera(widht=1)]),
            "match.yaml: cameras[1].widht",
            "width",
            "'widht'",
            "'width'?",
        ),
        (match(extra=1), "match.yaml: extra", "match_id", "'extra'", "Remove it"),
        (
            match(cameras=[camera(), camera()]),
            "match.yaml",
            "agree",
            "used twice: ['cam2']",
            "named",
        ),
        (match(cameras=[]), "match.yaml: cameras", "at least 1", "0", "Correct"),
        ([1], "match.yaml", "a mapping", "[1]", "Correct"),
    ],
)
def test_refusal_names_key_expected_found_and_what_to_do(data, where, expected, found, todo):
    error = refusal(data)
    assert error.where == where
    assert expected in error.expected
    assert found in error.found
    assert todo in error.todo
