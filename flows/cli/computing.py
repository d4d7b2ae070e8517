"""Options of the commands that compute: machines and time limits."""

from __future__ import annotations

from typing import Annotated

import typer

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
