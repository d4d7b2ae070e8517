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

from worldpose.errors import InputError, UsageError


def _require_rate(fps: float | None) -> float | None:
    if fps is not None and not 0.001 <= fps <= 100_000.0:
        raise typer.BadParameter(f"{fps:g} is not a number of frames per second")
    return fps


DEFAULT_PROJECT = "worldpose-data"
PAGES_PORT = 8571


def _shared(
    project: Annotated[str, typer.Option(envvar="WORLDPOSE_PROJECT")],
    as_json: Annotated[bool, typer.Option("--json")],
    match: Annotated[str, typer.Argument(metavar="MATCH")],
    run: str,
    stage: str | None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v")],
    fps: Annotated[float | None, typer.Option(callback=_require_rate)],
    dask: Annotated[str | None, typer.Option(metavar="ADDR")],
    workers: Annotated[int | None, typer.Option(min=1)],
    time_limits: Annotated[
        list[str] | None, typer.Option("--time-limit", metavar="[STAGE=]MINUTES")
    ],
    more_settings: Annotated[list[str] | None, typer.Option("--set", metavar="STAGE.NAME=VALUE")],
    body_folder: Path | None,
    who: Annotated[str, typer.Option(envvar="WORLDPOSE_REVIEWER")],
    port: Annotated[int, typer.Option(min=1, max=65535)],
    host: str,
    names: Annotated[list[str] | None, typer.Option("--host-name")],
    certificate: Path | None,
    key: Path | None,
    token: Annotated[str | None, typer.Option(envvar="WORLDPOSE_REVIEW_TOKEN", show_envvar=True)],
    users: Path | None,
    catalog: Annotated[Path | None, typer.Option(envvar="WORLDPOSE_MODEL_CATALOG")],
    folder: Path | None,
    overwrite: Annotated[bool, typer.Option("--overwrite")],
) -> None:
    """Options by the name of a command's parameter, which needs no annotation and no help there.

    Options:
        project: Folder or s3:// URL that holds all results.
        as_json: Print one JSON object.
        match: A match folder, or the id of a registered match.
        run: A run's number or name; by default the latest, with results.
        stage: Stage of the joints; the last by default.
        verbose: Print the metrics of each result too.
        fps: Frames per second; by default as the files say, or 50 of a data set.
        dask: A running Dask scheduler, tcp://host:port.
        workers: Worker processes on this machine; by default at most one per core.
        time_limits: Time limit of a unit [min]: a slower unit is stopped, retried once, and then
            given up. Repeatable; 360 in every stage by default.
        more_settings: A setting beyond those that worldpose settings MATCH shows; repeatable.
        body_folder: Folder of installed bodies (worldpose body install); by default that of
            WORLDPOSE_BODY_FOLDER, or else ~/.local/share/worldpose/bodies.
        who: Your name; it is recorded.
        port: Port of the pages.
        host: Address to listen on; by default, only this machine can connect.
        names: Name of this machine for other machines; repeatable.
        certificate: PEM file of the certificate for TLS.
        key: PEM file of the certificate's private key.
        token: Token with which people log in; by default, the server creates a new token.
        users: TOML file of the people who may log in, with their roles.
        catalog: YAML file with checkpoints of your own: name, address, digest.
        folder: Folder of pulled checkpoints; by default WORLDPOSE_MODEL_FOLDER, or the cache.
        overwrite: Also replace files of another match, or of unknown origin.
    """


def _described(function: Callable[..., None], known: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a function as options for Typer, by name.

    Help is in `Options:` of its docstring. A parameter that neither that nor an annotation for
    Typer describes is a `known` option. One that is false by default is a flag.
    """
    _, _, listed = (inspect.getdoc(function) or "").partition("\n\nOptions:\n")
    entries = (each.strip().partition(": ") for each in re.split(r"\n(?=    \S)", listed) if each)
    told = {name: " ".join(text.split()) for name, _, text in entries}
    hints, found = get_type_hints(function, include_extras=True), {}
    for name, each in inspect.signature(function).parameters.items():
        hint = hints[name]
        if get_origin(hint) is not Annotated:
            flag = [f"--{name.replace('_', '-')}"] if each.default is False else []
            is_known = name in known and name not in told
            hint = known[name] if is_known else Annotated[hint, typer.Option(*flag)]
        kind, option = get_args(hint)
        option = copy(option)
        option.help = told.get(name, option.help)
        found[name] = Annotated[kind, option]
    return found


SHARED: Final = _described(_shared, {})


def command_of(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command for Typer, from a function that says only what is its own.

    A parameter `store` becomes `--project`, whose store is opened at its first use: a command
    checks its own options before. Every command has `--json`.
    """
    if hasattr(function, "__signature__"):  # it is one
        return function
    options = _described(function, {**SHARED, "store": SHARED["project"]})
    takes_store = options.pop("store", None) is not None
    given = inspect.signature(function).parameters
    parameters = [given[name].replace(annotation=hint) for name, hint in options.items()]
    own = [("project", DEFAULT_PROJECT)] if takes_store else []
    parameters += (
        Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=SHARED[name])
        for name, default in (*own, ("as_json", False))
    )

    def command(*, as_json: bool, **given: Any) -> None:  # noqa: ANN401
        from flows.cli import console  # late: it imports pydantic

        console.output.quiet = as_json
        if "project" in given:
            require_answer(given["project"])
        if takes_store:
            from worldpose.store.store import LateStore

            given["store"] = LateStore(given.pop("project"))
        function(**given)

    about = (inspect.getdoc(function) or "").partition("\n\nOptions:\n")[0]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__name__, command.__doc__, command.__annotations__ = function.__name__, about, {}
    return command


def require_answer(project: str) -> None:
    """Refuse a project whose disk does not answer."""
    from flows.service.layout import DISK_SECONDS, disk_answers  # late: it imports pydantic

    file = Path(project).expanduser() / "project.json"
    if "://" not in project and not disk_answers(file):
        raise InputError(
            str(file),
            expected="a disk that answers",
            found=f"no answer within {DISK_SECONDS:g} s",
            todo="Look after the disk, or the network to it. Results are unchanged.",
        )


def given_options(command: Callable[..., None], values: Mapping[str, object]) -> list[str]:
    """Return the options of a command whose values, by parameter, are not its defaults."""
    return [
        f"--{name.replace('_', '-')}"
        for name, each in inspect.signature(command).parameters.items()
        if each.default is not Parameter.empty and values[name] not in (each.default, None, [])
    ]


def certificate_and_key(certificate: Path | None, key: Path | None) -> tuple[Path, Path] | None:
    """Return both files, or None if neither is given."""
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
    """Refuse a key that others than its owner can read; root's may be readable by a group."""
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
