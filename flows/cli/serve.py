"""Command serve: a project served day and night."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.console import DEFAULT_PROJECT, JsonOption, ProjectOption, errors, line, print_json
from worldpose.errors import UsageError

if TYPE_CHECKING:
    from flows.operations.layout import StateFolder

PAGES = 8571


def serve(
    inbox: Annotated[
        Path | None,
        typer.Option("--inbox", help="Folder in which matches arrive; PROJECT/inbox by default."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Say what is unhealthy and how to mend it, and end.")
    ] = False,
    at_once: Annotated[int, typer.Option(min=1, help="Matches that run at the same time.")] = 1,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDR", help="A running Dask scheduler, tcp://host:port.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Worker processes of a run; its share of the cores.")
    ] = None,
    name: Annotated[
        str, typer.Option(help="Of the deployments; projects at one Prefect server need their own.")
    ] = "worldpose",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Of the pages.")] = PAGES,
    prefect_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Of Prefect's dashboard, on this machine alone.")
    ] = 4200,
    metrics_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Of the figures for Prometheus.")
    ] = 8573,
    host: Annotated[str, typer.Option(help="Address that pages and figures listen at.")] = (
        "127.0.0.1"
    ),
    names: Annotated[
        list[str] | None,
        typer.Option("--host-name", help="Name of this machine elsewhere; repeatable."),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="PEM file; with --key: pages with TLS.")
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", help="PEM file of its private key.")] = None,
    quiet: Annotated[
        float, typer.Option(min=0, help="A match has arrived when unchanged for so long [s].")
    ] = 30.0,
    sweep: Annotated[
        float, typer.Option(min=0.1, help="How often the inbox is gone through on schedule [min].")
    ] = 15.0,
    gate_hours: Annotated[
        float, typer.Option(min=0.001, help="Waiting for people longer than this alerts [h].")
    ] = 24.0,
    disk_gb: Annotated[
        float, typer.Option(min=0, help="Less free space than this alerts [GB].")
    ] = 10.0,
    state: Annotated[
        Path | None,
        typer.Option(help="Folder of logs and Prefect's database; PROJECT/operations by default."),
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(
            envvar="WORLDPOSE_REVIEW_TOKEN",
            show_envvar=True,
            help="What people log in to the pages with; a new one by default.",
        ),
    ] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Serve a project until interrupted: dashboard, inbox, runs, pages, figures, alerts.

    Alerts go to the webhook in WORLDPOSE_ALERT_URL. PREFECT_API_URL names a Prefect server that
    runs already.

    Example: worldpose serve --inbox /data/arriving
    """
    # Late: no other command needs them.
    from flows.operations.layout import state_folder
    from flows.operations.plan import ServePlan
    from worldpose.store.blobs import open_blobs

    url = open_blobs(project).url
    folder = state_folder(url, state)
    if check:
        _check(folder, as_json=as_json)
        return
    from flows.operations.serving import serve as serve_all
    from flows.pages.access import access_for

    if (certificate is None) != (key is None):
        raise UsageError(
            "--certificate and --key",
            expected="both or none",
            found="one of them",
            todo="Give the certificate's file and its private key's.",
        )
    if inbox is None and "://" in url:
        raise UsageError(
            "--inbox",
            expected="a folder on this machine",
            found="none, and a project on object storage",
            todo="Name one, as in --inbox /data/arriving.",
        )
    given = os.environ.get("PREFECT_API_URL")
    plan = ServePlan(
        project=url,
        inbox=(inbox or Path(url) / "inbox").resolve(),
        state=folder.folder,
        name=name,
        prefect=(given or f"http://127.0.0.1:{prefect_port}/api").rstrip("/"),
        owns_prefect=not given,
        at_once=at_once,
        dask=dask,
        workers=workers,
        host=host,
        names=tuple(names or ()),
        pages_port=port,
        metrics_port=metrics_port,
        certificate=certificate,
        key=key,
        quiet_seconds=quiet,
        sweep_minutes=sweep,
        gate_hours=gate_hours,
        disk_gb=disk_gb,
    )
    access = access_for(host, token=token, names=names or (), secure=certificate is not None)

    def ready() -> None:
        line(f"serving {plan.project}")
        line(f"inbox          {plan.inbox}")
        line(f"dashboard      {plan.dashboard}")
        # A token that somebody chose is not said: this may go to a log.
        login = "/login" if token else f"/login#token={access.token}"
        line(f"review pages   {plan.pages}{login}")
        line(f"status page    {plan.pages}/status")
        line(f"figures        http://{host}:{metrics_port}/metrics")
        line("Ctrl-C ends it; begun again it goes on where it was")

    serve_all(plan, access.token, ready, lambda text: line(text, to=errors))


def _check(folder: StateFolder, *, as_json: bool) -> None:
    from flows.operations.health import check

    findings = check(folder)
    if as_json:
        print_json(
            {
                "healthy": all(finding.is_well for finding in findings),
                "findings": [
                    {
                        "part": each.part,
                        "well": each.is_well,
                        "state": each.state,
                        "mend": each.mend,
                    }
                    for each in findings
                ],
            }
        )
    for finding in [] if as_json else findings:
        line(f"{'ok' if finding.is_well else 'UNHEALTHY':<10}{finding.part}: {finding.state}")
        if not finding.is_well:
            line(f"          mend: {finding.mend}")
    if not all(finding.is_well for finding in findings):
        raise typer.Exit(1)


def add_to(app: typer.Typer) -> None:
    """Register this command."""
    app.command()(serve)
