"""Installing packages as pip is configured to."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "infra" / "install_packages.py"


@pytest.fixture
def installer() -> ModuleType:
    spec = importlib.util.spec_from_file_location("install_packages", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_uv_gets_the_indexes_that_pip_has(
    installer: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    configured = tmp_path / "pip.conf"
    configured.write_text(
        "[global]\nindex-url = https://a.example/simple\nfind-links = /unused\n"
        "[install]\nextra-index-url =\n  https://b.example/simple\n  https://c.example/simple\n"
    )
    monkeypatch.setenv("PIP_CONFIG_FILE", str(configured))
    for name in ("INDEX_URL", "EXTRA_INDEX_URL", "NO_INDEX", "TRUSTED_HOST"):
        monkeypatch.delenv(f"PIP_{name}", raising=False)
    monkeypatch.setenv("PIP_FIND_LINKS", "/wheels")
    command = " ".join(installer.uv_command(installer.pip_settings()))
    assert "--index-url https://a.example/simple" in command
    both = "--extra-index-url https://b.example/simple --extra-index-url https://c.example/simple"
    assert both in command
    assert "--find-links /wheels" in command  # the environment counts more than the file
    assert "--no-index" not in command


def test_no_index_and_trusted_hosts_are_kept(installer: ModuleType) -> None:
    command = " ".join(
        installer.uv_command({"no-index": "true", "trusted-host": "a.example b.example"})
    )
    assert "--no-index" in command
    assert "--allow-insecure-host a.example --allow-insecure-host b.example" in command
