from __future__ import annotations

from typing import Any

import pytest
from store_samples import sample_recipe

from worldpose.store.recipes import recipe_differences, recipe_key


def describe(old, new):
    return [str(each) for each in recipe_differences(old, new)]


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
