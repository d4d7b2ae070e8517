"""Options of commands: how functions become commands, and the options that these share."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from copy import copy
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, Final, get_args, get_origin, get_type_hints

import typer

from worldpose.errors import UsageError


def _require_rate(fps: float | None) -> float | None:
    if fps is not None and not 0.001 <= fps <= 100_000.0:
        raise typer.BadParameter(f"{fps:g} is not a number of frames per second")
    return fps


DEFAULT_PROJECT = "worldpose-data"
PAGES_PORT = 8571

ProjectOption = Annotated[
    str,
    typer.Option(envvar="WORLDPOSE_PROJECT", help="Folder or s3:// URL that holds all results."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
SHARED: Final[Mapping[str, Any]] = {
    "project": ProjectOption,
    "match": Annotated[
        str,
        typer.Argument(metavar="MATCH", help="A match folder, or the id of a registered match."),
    ],
    "run": Annotated[
        str, typer.Option(help="A run's number or name; by default the latest, with results.")
    ],
    "stage": Annotated[str | None, typer.Option(help="Stage of the joints; the last by default.")],
    "verbose": Annotated[
        bool, typer.Option("--verbose", "-v", help="Print the metrics of each result too.")
    ],
    "fps": Annotated[
        float | None,
        typer.Option(
            callback=_require_rate,
            help="Frames per second; by default as the files say, or 50 of a data set.",
        ),
    ],
    "dask": Annotated[
        str | None, typer.Option(metavar="ADDR", help="A running Dask scheduler, tcp://host:port.")
    ],
    "workers": Annotated[
        int | None,
        typer.Option(
            min=1, help="Worker processes on this machine; by default at most one per core."
        ),
    ],
    "time_limits": Annotated[
        list[str] | None,
        typer.Option(
            "--time-limit",
            metavar="[STAGE=]MINUTES",
            help="Time limit of a unit [min]: a slower unit is stopped, retried once, and then "
            "given up. Repeatable; 360 in every stage by default.",
        ),
    ],
    "more_settings": Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="STAGE.NAME=VALUE",
            help="A setting beyond those that worldpose settings MATCH shows; repeatable.",
        ),
    ],
    "body_folder": Annotated[
        Path | None,
        typer.Option(
            help="Folder of installed bodies (worldpose body install); by default that of "
            "WORLDPOSE_BODY_FOLDER, or else ~/.local/share/worldpose/bodies."
        ),
    ],
    "who": Annotated[
        str, typer.Option(envvar="WORLDPOSE_REVIEWER", help="Your name; it is recorded.")
    ],
    "port": Annotated[int, typer.Option(min=1, max=65535, help="Port of the pages.")],
    "host": Annotated[
        str, typer.Option(help="Address to listen on; by default, only this machine can connect.")
    ],
    "names": Annotated[
        list[str] | None,
        typer.Option("--host-name", help="Name of this machine for other machines; repeatable."),
    ],
    "certificate": Annotated[
        Path | None, typer.Option(help="PEM file of the certificate for TLS.")
    ],
    "key": Annotated[Path | None, typer.Option(help="PEM file of the certificate's private key.")],
    "token": Annotated[
        str | None,
        typer.Option(
            envvar="WORLDPOSE_REVIEW_TOKEN",
            show_envvar=True,
            help="Token with which people log in; by default, the server creates a new token.",
        ),
    ],
    "users": Annotated[
        Path | None,
        typer.Option(help="TOML file of the people who may log in, with their roles."),
    ],
}
"""Options by the name of a command's parameter, which need no annotation and no help there."""


def command_of(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command for Typer, from a function that says only what is its own.

    Help is in `Options:` of its docstring, or in `SHARED`. A parameter without annotation for Typer
    that either describes is an option; one that is false by default is a flag. A parameter `store`
    becomes `--project`, whose store must exist. Every command has `--json`.
    """
    if hasattr(function, "__signature__"):  # it is one
        return function
    about, _, listed = (inspect.getdoc(function) or "").partition("\n\nOptions:\n")
    entries = (each.strip().partition(": ") for each in re.split(r"\n(?=    \S)", listed) if each)
    told = {name: " ".join(text.split()) for name, _, text in entries}
    hints = get_type_hints(function, include_extras=True)
    parameters = []
    for name, each in inspect.signature(function).parameters.items():
        hint = hints[name]
        if get_origin(hint) is not Annotated:
            flag = [f"--{name.replace('_', '-')}"] if each.default is False else []
            is_shared = name in SHARED and name not in told
            hint = SHARED[name] if is_shared else Annotated[hint, typer.Option(*flag)]
        kind, option = get_args(hint)
        option = copy(option)
        option.help = told.get(name, option.help)
        if name != "store":
            parameters.append(each.replace(annotation=Annotated[kind, option]))
    own = [("project", DEFAULT_PROJECT, ProjectOption)] if "store" in hints else []
    for name, default, hint in (*own, ("as_json", False, JsonOption)):
        parameters.append(Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=hint))

    def command(*, as_json: bool, **given: Any) -> None:  # noqa: ANN401
        from flows.cli import console  # late: it imports pydantic

        console.output.quiet = as_json
        if own:
            from worldpose.store.store import Store

            given["store"] = Store.open(given.pop("project"))
        function(**given)

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__name__, command.__doc__, command.__annotations__ = function.__name__, about, {}
    return command


def given_options(command: Callable[..., None], values: Mapping[str, object]) -> list[str]:
    """Return the options of a command whose values, by parameter, are not its defaults."""
    return [
        f"--{name.replace('_', '-')}"
        for name, each in inspect.signature(command).parameters.items()
        if each.default is not Parameter.empty and values[name] not in (each.default, None, [])
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
