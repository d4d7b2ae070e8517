from __future__ import annotations

import hashlib
import sys
from typing import Any

import pytest
from store_samples import sample_recipe

from worldpose.store.recipes import libraries, recipe_differences, recipe_key


def describe(old, new):
    return [str(each) for each in recipe_differences(old, new)]


def test_key_is_the_first_half_of_the_sha256_of_the_recipe() -> None:
    text = (
        '{"code":{"worldpose.tracking":"' + "b" * 64 + '"},"contract":1,"inputs":{},'
        '"libraries":{"numpy":"2.4.0"},"match_id":"final","settings":{"gate":{"max_distance":0.5}},'
        '"sources":{"pitch":"' + "a" * 64 + '"},"stage":"tracking","unit":"clip"}'
    )
    assert recipe_key(sample_recipe()) == hashlib.sha256(text.encode()).hexdigest()[:32]


def test_equal_recipes_have_no_difference() -> None:
    assert describe(sample_recipe(), sample_recipe()) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"unit": "late"}, "unit: tracking/clip -> tracking/late"),
        ({"match_id": "semi"}, "match: final -> semi"),
        ({"sources": {"pitch": "f" * 64}}, "source pitch: aaaaaaaaaaaa... -> ffffffffffff..."),
        ({"sources": {}}, "source pitch: aaaaaaaaaaaa... -> absent"),
        ({"inputs": {"ingest/left": "e" * 32}}, "input ingest/left: absent -> eeeeeeeeeeee..."),
        (
            {"settings": {"gate": {"max_distance": 0.7}}},
            "setting gate.max_distance: 0.5 -> 0.7",
        ),
        ({"settings": {"gate": {"max_distance": None}}}, "setting gate.max_distance: 0.5 -> null"),
        (
            {"code": {"worldpose.tracking": "c" * 64}},
            "module worldpose.tracking: bbbbbbbbbbbb... -> cccccccccccc...",
        ),
        ({"libraries": {"numpy": "2.5.0"}}, "library numpy: 2.4.0 -> 2.5.0"),
    ],
)
def test_every_change_has_its_own_line_and_its_own_key(change: dict[str, Any], line: str) -> None:
    changed = sample_recipe(**change)
    assert describe(sample_recipe(), changed) == [line]
    assert recipe_key(changed) != recipe_key(sample_recipe())


def test_digests_that_begin_alike_are_still_a_difference() -> None:
    one = sample_recipe(sources={"pitch": "a" * 64})
    other = sample_recipe(sources={"pitch": "a" * 63 + "b"})
    assert len(describe(one, other)) == 1


def test_a_difference_inside_a_list_is_named_by_its_place() -> None:
    old = sample_recipe().model_copy(update={"sources": {"camera": {"focal_px": [1000.0, 1001.0]}}})
    new = sample_recipe().model_copy(update={"sources": {"camera": {"focal_px": [1000.0, 1002.0]}}})
    assert describe(old, new) == ["source camera.focal_px[1]: 1001.0 -> 1002.0"]


def test_libraries_are_named_with_versions() -> None:
    versions = libraries()
    assert versions["python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    assert versions["numpy"][0].isdigit()
    assert "store" in versions
