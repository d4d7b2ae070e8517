"""Options that commands share: machines and time limits of runs, address and access of pages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from worldpose.errors import UsageError


def _require_rate(fps: float | None) -> float | None:
    if fps is not None and not 0.001 <= fps <= 100_000.0:
        raise typer.BadParameter(f"{fps:g} is not a number of frames per second")
    return fps


FpsOption = Annotated[
    float | None,
    typer.Option(
        "--fps",
        callback=_require_rate,
        help="Frames per second; by default as the files say, or 50 of a data set.",
    ),
]
DaskOption = Annotated[
    str | None, typer.Option(metavar="ADDR", help="A running Dask scheduler, tcp://host:port.")
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, help="Worker processes on this machine; by default at most one per core."),
]
TimeLimitOption = Annotated[
    list[str] | None,
    typer.Option(
        "--time-limit",
        metavar="[STAGE=]MINUTES",
        help="Time limit of a unit [min]: a slower unit is stopped, retried once, and then given "
        "up. Repeatable; 360 in every stage by default.",
    ),
]

MoreSettingsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="STAGE.NAME=VALUE",
        help="A setting beyond those that worldpose settings MATCH shows; repeatable.",
    ),
]
BodyFolderOption = Annotated[
    Path | None,
    typer.Option(
        help="Folder of installed bodies (worldpose body install); by default that of "
        "WORLDPOSE_BODY_FOLDER, or else ~/.local/share/worldpose/bodies."
    ),
]

PAGES_PORT = 8571

PortOption = Annotated[int, typer.Option(min=1, max=65535, help="Port of the pages.")]
HostOption = Annotated[
    str, typer.Option(help="Address to listen on; by default, only this machine can connect.")
]
NamesOption = Annotated[
    list[str] | None,
    typer.Option("--host-name", help="Name of this machine for other machines; repeatable."),
]
CertificateOption = Annotated[
    Path | None, typer.Option("--certificate", help="PEM file of the certificate for TLS.")
]
KeyOption = Annotated[
    Path | None, typer.Option("--key", help="PEM file of the certificate's private key.")
]
TokenOption = Annotated[
    str | None,
    typer.Option(
        envvar="WORLDPOSE_REVIEW_TOKEN",
        show_envvar=True,
        help="Token with which people log in; by default, the server creates a new token.",
    ),
]
UsersOption = Annotated[
    Path | None,
    typer.Option("--users", help="TOML file of the people who may log in, with their roles."),
]


def certificate_and_key(certificate: Path | None, key: Path | None) -> tuple[Path, Path] | None:
    """Return both files, or None if neither is given.

    Raises:
        UsageError: only one of them is given, or other users can read or write the key.
    """
    if certificate is not None and key is not None:
        require_private_key(key)
        return certificate, key
    if certificate is None and key is None:
        return None
    raise UsageError(
        "--certificate and --key",
        expected="both or none",
        found="one of them",
        todo="Give both files: the certificate and its private key.",
    )


def require_private_key(key: Path) -> None:
    """Refuse a key that others than its owner can read; root's may be readable by a group.

    Raises:
        UsageError: there is no such file, or it has other rights.
    """
    try:
        found = key.stat()
    except OSError as error:
        raise UsageError(
            f"--key {key}",
            expected="a readable file",
            found=error.strerror or str(error),
            todo="Correct the name, or the rights of its folder.",
        ) from error
    others = 0o037 if found.st_uid == 0 else 0o077
    if found.st_mode & others:
        raise UsageError(
            f"--key {key}",
            expected="a private key that its owner alone can read and write",
            found=f"mode {found.st_mode & 0o777:o}",
            todo=f"Run: chmod 600 {key}. If others could read it, make a new key.",
        )
