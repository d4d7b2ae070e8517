"""A person at the pages, in a real browser; images go to the folder WORLDPOSE_PAGE_SHOTS."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

MODULES = Path(__file__).parents[1] / "infra" / "review_pages" / "node_modules"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

IN_BROWSER = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
    pytest.mark.skipif(
        not (MODULES / "playwright-core").is_dir() or shutil.which("node") is None,
        reason="no playwright-core: npm ci in infra/review_pages",
    ),
]


def drive(script, task, folder, seconds):
    """Return the observations of a browser script that does a task on the pages."""
    given = {
        **task,
        "modules": str(MODULES / "package.json"),
        "chromium": CHROMIUM,
        "shots": os.environ.get("WORLDPOSE_PAGE_SHOTS"),
    }
    file = folder / "task.json"
    file.write_text(json.dumps(given))
    done = subprocess.run(
        ["node", script, file], capture_output=True, text=True, timeout=seconds, check=False
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["errors"] == [], seen["errors"]
    assert seen["outside"] == [], seen["outside"]
    return seen
