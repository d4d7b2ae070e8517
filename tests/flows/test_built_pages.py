"""The review pages that ship are those that their sources make."""

import hashlib
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "infra" / "review_pages"
BUILT = ROOT / "flows" / "web" / "static"
VIEWER = ROOT / "flows" / "reports" / "viewer.html"


def source_digest():
    """As `vite.config.js` computes it when it builds."""
    top = "index.html", "package-lock.json", "viewer.config.js", "viewer.html", "vite.config.js"
    files = [SOURCES / name for name in top]
    files += [file for file in (SOURCES / "src").rglob("*") if file.is_file()]
    sha = hashlib.sha256()
    for path in sorted(file.relative_to(SOURCES).as_posix() for file in files):
        sha.update(f"{path}\0".encode() + (SOURCES / path).read_bytes() + b"\0")
    return sha.hexdigest()


def test_the_built_pages_are_of_the_sources_as_they_are():
    built = (BUILT / "built_from.sha256").read_text().strip()
    assert built == source_digest(), "build them again: make pages"


@pytest.mark.slow
@pytest.mark.skipif(
    not (SOURCES / "node_modules" / "vite").is_dir(), reason="no vite: npm ci in infra/review_pages"
)
def test_building_the_sources_gives_the_committed_bytes(tmp_path):
    out = tmp_path / "static"
    for config in ("vite.config.js", "viewer.config.js"):
        command = [shutil.which("npx"), "vite", "build", "--config", config, "--outDir", str(out)]
        subprocess.run(command, cwd=SOURCES, check=True, capture_output=True, timeout=300)
    assert (out / "viewer.html").read_bytes() == VIEWER.read_bytes()
    (out / "viewer.html").unlink()
    made = {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    kept = {file.relative_to(BUILT): file.read_bytes() for file in BUILT.rglob("*.*")}
    assert made == kept


def test_the_viewer_may_request_nothing():
    page = VIEWER.read_text()
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    allowed = dict(each.strip().split(" ", 1) for each in policy.split(";"))
    assert allowed.pop("default-src") == "'none'"
    assert set(" ".join(allowed.values()).split()) == {"'unsafe-inline'", "data:", "blob:"}
    assert re.findall(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=", page) == [
        '<link rel="icon" href='
    ]
