"""The settings page in a real browser."""

from pathlib import Path

import pytest
from chromium import IN_BROWSER, drive
from command_line import TINY
from page_client import TOKEN, serving

pytestmark = IN_BROWSER


@pytest.mark.timeout(600)
def test_a_person_changes_the_settings_of_the_project_and_of_a_match(project_copy, tmp_path):
    script = Path(__file__).with_name("settings_in_browser.mjs")
    with serving(project_copy, tmp_path) as base:
        task = {"base": base, "match": TINY, "token": TOKEN}
        seen = drive(script, task, tmp_path, 300)
    assert seen["project"] == ["tracking.gate_m\t0.45\t0.5\tproject"]
    assert seen["match"] == ["tracking.gate_m\t0.6\t0.5\tmatch"]
    assert max(value for name, value in seen.items() if name.startswith("overflow")) <= 0
