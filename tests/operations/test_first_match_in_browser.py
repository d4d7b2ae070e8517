"""A stranger's path: one command, a match in the inbox, and then only what a browser shows."""

import json
import shutil
from pathlib import Path

import pytest
from chromium import IN_BROWSER, drive
from command_line import succeed
from service import TOKEN

from worldpose.store.store import Store

pytestmark = [*IN_BROWSER, pytest.mark.timeout(3600)]
SCRIPT = Path(__file__).with_name("first_match_in_browser.mjs")
MATCH = "tiny-0-0.5s"


def test_a_match_goes_from_the_inbox_to_its_release_in_a_browser(served, tmp_path, capsys):
    succeed("simulate", "--scenario", "tiny", "--duration", 0.5, "--out", tmp_path / "match")
    served.begin()
    shutil.copytree(tmp_path / "match", served.project / "inbox" / "first")
    released = served.project / "releases" / MATCH
    task = {
        "prefect": f"http://127.0.0.1:{served.ports['prefect']}",
        "pages": f"http://127.0.0.1:{served.ports['pages']}",
        "token": TOKEN,
        "login": served.secret("prefect"),
        "match": MATCH,
        "release": {"name": "v1", "licence": "for tests"},
        "report": str(released / "v1-report.html"),
        "patience": 1500,
    }
    seen = drive(SCRIPT, task, tmp_path, 3500)
    assert seen["questions"] > 0
    assert MATCH in seen["report"]
    record = Store.open(str(served.project)).run(MATCH)
    assert (record.state, record.failed, record.waiting) == ("complete", (), ())
    assert json.loads((released / "v1" / "manifest.json").read_text())["release"] == "v1"
    with capsys.disabled():
        print(f"\nseconds since the match arrived in the inbox: {seen['seconds']}")
        print(f"runs that Prefect refused to create at first: {seen.get('refused', [])}")
