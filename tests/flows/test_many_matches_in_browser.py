"""Pages paint at once with 200 matches and 5,000 corrections, in a real browser."""

from pathlib import Path

import page_client
import pytest
from chromium import IN_BROWSER, drive
from command_line import TINY
from long_journal import write_corrections
from many_matches import copy_match

from worldpose.store.store import Store

pytestmark = [*IN_BROWSER, pytest.mark.timeout(3000)]
SCRIPT = Path(__file__).with_name("many_matches_in_browser.mjs")
MATCHES, CORRECTIONS = 200, 5000
PAINT_SECONDS = 1.0
STATUS_SECONDS = 0.5


def test_pages_paint_within_a_second(project_copy, tmp_path, capsys):
    copy_match(project_copy, TINY, MATCHES - 1)
    write_corrections(Store.open(str(project_copy)), TINY, CORRECTIONS)
    with page_client.serving(project_copy, tmp_path) as base:
        task = {"base": base, "token": page_client.TOKEN, "match": TINY, "count": MATCHES}
        seen = drive(SCRIPT, task, tmp_path, 900)
    with capsys.disabled():
        print(f"\nfirst paint [s]: {seen['paint']}; content [s]: {seen['shown']}")
    assert (seen["rows"], seen["sought"]) == (50, f"{TINY}-copy017")
    text = seen["paint"].pop("text")  # a file of text: what the machine needs for any page
    assert max(seen["paint"].values()) < text + PAINT_SECONDS
    assert seen["paint"]["status"] < text + STATUS_SECONDS
    assert {name: value for name, value in seen.items() if "overflow" in name and value} == {}
