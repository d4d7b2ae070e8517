"""Small units in one task: each is published or fails as in a task of its own."""

from types import SimpleNamespace

import pytest

from data_contracts.work import Recipe, Work
from tasks import batch, tracking
from worldpose.errors import DegenerateError, StoreError
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store


@pytest.fixture
def works(tmp_path):
    """Work on three units of a project."""
    Store.create(str(tmp_path))
    recipes = [
        Recipe(
            match_id="m",
            stage="tracking",
            unit=unit,
            sources={},
            inputs={},
            settings={},
            code={},
            libraries={},
        )
        for unit in ("a", "b", "c")
    ]
    return [
        Work(project=str(tmp_path), folder="m", recipe=each, key=recipe_key(each), run_id="0001")
        for each in recipes
    ]


def run(works, compute, monkeypatch):
    monkeypatch.setattr(tracking, "tracking", SimpleNamespace(fn=compute))
    monkeypatch.setattr(batch, "RETRY_SECONDS", 0.0)
    return batch.batch.fn("tracking", "tasks.tracking", [each.model_dump_json() for each in works])


def test_a_units_failure_is_its_own(works, monkeypatch):
    done = []

    def compute(work):
        if work.recipe.unit == "b":
            raise DegenerateError("no person to be seen")
        done.append(work)

    failures = run(works, compute, monkeypatch)
    assert [type(each) for each in failures] == [type(None), DegenerateError, type(None)]
    assert sorted(each.recipe.unit for each in done) == ["a", "c"]


def test_what_may_pass_is_tried_again_and_what_is_there_is_not(works, monkeypatch):
    tried = []

    def compute(work):
        tried.append(work.recipe.unit)
        if work.recipe.unit == "c" or (tried.count("b") == 1 and work.recipe.unit == "b"):
            raise StoreError("no space")

    monkeypatch.setattr(Store, "has", lambda self, match, stage, unit, key: unit == "a")
    failures = run(works, compute, monkeypatch)
    assert sorted(tried) == ["b", "b", "c", "c", "c"]
    assert [type(each) for each in failures] == [type(None), type(None), StoreError]
