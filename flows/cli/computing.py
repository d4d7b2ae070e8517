"""Options of the commands that compute: machines and time limits."""

from __future__ import annotations

from typing import Annotated

import typer

DaskOption = Annotated[
    str | None, typer.Option(metavar="ADDR", help="A running Dask scheduler, tcp://host:port.")
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, help="Worker processes of a run on this machine; by default one a core."),
]
TimeLimitOption = Annotated[
    list[str] | None,
    typer.Option(
        "--time-limit",
        metavar="[STAGE=]MINUTES",
        help="A unit that is at work for longer is stopped, begun once more, and then given up; "
        "may be repeated; by default 360 in every stage.",
    ),
]
