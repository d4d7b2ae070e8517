import importlib
import json
from pathlib import Path

import pytest

RECIPE = Path(__file__).parents[3] / "infra" / "embedded_detector"


class KilledError(Exception):
    pass


@pytest.mark.slow
def test_the_shipped_recipe_goes_on_where_it_was_killed_and_ends_with_the_same_weights(
    tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(RECIPE)
    recipe = importlib.import_module("train")
    # One scene of each set; two steps of each phase, or a few.
    share, undisturbed, killed = 5e-4, tmp_path / "undisturbed", tmp_path / "killed"
    recipe.main(undisturbed, ["scenes", "people", "keypoints", "figures"], share, {})
    figures = json.loads((undisturbed / "figures.json").read_text())
    assert figures["pictures"] == 8 and 0 < figures["keypoints"]["all"]["pck"] < 1

    killed.mkdir()
    for name in recipe.SCENES:
        (killed / name).symlink_to(undisturbed / name)
    said, deaths = [], []

    def mortal(line):
        said.append(line)
        if line.startswith("step 2 of 2") and len(deaths) < len(parts):
            deaths.append(line)
            raise KilledError

    monkeypatch.setattr(recipe, "say", mortal)
    parts = []
    for part in ("people", "keypoints"):
        parts.append(part)
        # It dies in the second phase, after its first checkpoint.
        with pytest.raises(KilledError):
            recipe.main(killed, [part], share, {})
        assert not (killed / f"embedded_{part}.safetensors").exists()
        recipe.main(killed, [part], share, {})
        name = f"embedded_{part}.safetensors"
        assert (killed / name).read_bytes() == (undisturbed / name).read_bytes()
    assert said.count("resumes after step 1") == 2
