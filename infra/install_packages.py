"""Installs packages into the environment of the Python that runs this.

    python infra/install_packages.py [ARGUMENT ...]

Arguments are those of `pip install`. uv installs, which takes a tenth of pip's time. It does not
read pip's configuration, so it is given what that says of indexes and certificates. pip installs
where uv cannot.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

OPTIONS = {
    "index-url": "--index-url",
    "extra-index-url": "--extra-index-url",
    "find-links": "--find-links",
    "trusted-host": "--allow-insecure-host",
}
"""Settings of pip, and options of uv with the same meaning."""


def pip_settings() -> dict[str, str]:
    """Return pip's settings: those of the environment, of `pip install`, and all others."""
    listed = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    ).stdout
    found: dict[str, dict[str, str]] = {}
    for line in listed.splitlines():
        name, _, value = line.partition("=")
        section, _, key = name.partition(".")
        found.setdefault(section, {})[key] = str(ast.literal_eval(value))
    return {**found.get("global", {}), **found.get("install", {}), **found.get(":env:", {})}


def uv_command(settings: dict[str, str]) -> list[str]:
    """Return uv's command that installs as pip would, without what to install."""
    command = [str(Path(sys.executable).with_name("uv")), "pip", "install"]
    command += ["--python", sys.executable]
    if "extra-index-url" in settings:  # pip takes a version from any index that its user trusts
        command += ["--index-strategy", "unsafe-best-match"]
    for key, option in OPTIONS.items():
        for value in settings.get(key, "").split():
            command += [option, value]
    return command + (["--no-index"] if settings.get("no-index") in ("1", "true") else [])


def main() -> None:
    """Install with uv, and otherwise with pip."""
    settings = pip_settings()
    environment = dict(os.environ)
    if "cert" in settings:
        environment.setdefault("SSL_CERT_FILE", settings["cert"])
    pip = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--no-compile"]
    uv = uv_command(settings)
    if not Path(uv[0]).exists():
        subprocess.run([*pip, "--quiet", "uv"], check=False)
    if Path(uv[0]).exists():
        if subprocess.run([*uv, *sys.argv[1:]], env=environment, check=False).returncode == 0:
            return
        print("uv could not install these packages; pip tries, which takes longer", flush=True)
    sys.exit(subprocess.run([*pip, *sys.argv[1:]], check=False).returncode)


if __name__ == "__main__":
    main()
