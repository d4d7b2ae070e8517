"""Command serve: continuous processing of a project."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.console import DEFAULT_PROJECT, JsonOption, ProjectOption, errors, line, print_json
from flows.cli.options import (
    PAGES_PORT,
    CertificateOption,
    DaskOption,
    HostOption,
    KeyOption,
    NamesOption,
    PortOption,
    TimeLimitOption,
    TokenOption,
    UsersOption,
    WorkersOption,
    certificate_and_key,
)
from flows.orchestration.time_limits import parse_time_limits
from worldpose.errors import UsageError

if TYPE_CHECKING:
    from flows.service.layout import StateFolder
    from flows.service.plan import ServePlan


def serve(
    inbox: Annotated[
        Path | None,
        typer.Option("--inbox", help="Folder of arriving matches; PROJECT/inbox by default."),
    ] = None,
    videos: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder whose videos people can pick on the pages, read-only; repeatable."
        ),
    ] = None,
    bucket: Annotated[
        str | None,
        typer.Option("--bucket", help="s3:// URL of matches to copy to the inbox."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Report problems and their remedies, and exit.")
    ] = False,
    test_alerts: Annotated[
        bool, typer.Option("--test-alerts", help="Send a test alert to every channel, and exit.")
    ] = False,
    max_concurrent: Annotated[
        int, typer.Option(min=1, help="Matches that run at the same time.")
    ] = 1,
    dask: DaskOption = None,
    workers: WorkersOption = None,
    time_limits: TimeLimitOption = None,
    name: Annotated[
        str, typer.Option(help="Name of the deployments, unique at a Prefect server.")
    ] = "worldpose",
    port: PortOption = PAGES_PORT,
    prefect_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Port of Prefect's dashboard on this machine.")
    ] = 4200,
    metrics_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Port of the metrics for Prometheus.")
    ] = 8573,
    host: HostOption = "127.0.0.1",
    names: NamesOption = None,
    certificate: CertificateOption = None,
    key: KeyOption = None,
    settle_time: Annotated[
        float,
        typer.Option(min=0, help="Time without changes until a match counts as complete [s]."),
    ] = 30.0,
    poll_interval: Annotated[
        float, typer.Option(min=0.1, help="Interval between scans of the inbox [min].")
    ] = 15.0,
    gate_hours: Annotated[
        float, typer.Option(min=0.001, help="Age of a pending review that triggers an alert [h].")
    ] = 24.0,
    disk_gb: Annotated[
        float, typer.Option(min=0, help="Free disk space below which an alert is sent [GB].")
    ] = 10.0,
    state: Annotated[
        Path | None,
        typer.Option(help="Folder of logs and Prefect's database; PROJECT/operations by default."),
    ] = None,
    token: TokenOption = None,
    users: UsersOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Serve a project until interrupted: pages, runs, inbox, dashboard, metrics, alerts.

    Open the printed address in a browser: its pages create, calibrate, run, review and show
    matches.

    Alerts go to the channels in PROJECT/operations/secrets/alerts.toml, or of WORLDPOSE_ALERT_URL
    and WORLDPOSE_ALERT_MAIL.
    PREFECT_API_URL names a Prefect server that runs already.

    Example: worldpose serve --inbox /data/arriving
    """
    # Imported here: no other command needs them.
    from flows.service.layout import state_folder
    from flows.service.plan import ServePlan
    from worldpose.store.store import open_blobs

    url = open_blobs(project).url
    folder = state_folder(url, state)
    if check:
        _check(folder, as_json=as_json)
        return
    if test_alerts:
        _test_alerts(folder, as_json=as_json)
        return
    from flows.service.channels import channels_of
    from flows.service.service_secrets import PAGES_TOKEN, secrets_of
    from flows.service.serving import serve as serve_all
    from flows.web.access import access_for

    channels_of(os.environ, folder.alert_settings)  # refused here, not in an unread log
    tls = certificate_and_key(certificate, key)
    if inbox is None and "://" in url:
        raise UsageError(
            "--inbox",
            expected="a folder on this machine",
            found="none, and a project on object storage",
            todo="Name a folder, as in --inbox /data/arriving.",
        )
    for each in videos or ():
        if not each.is_dir():
            raise UsageError(
                f"--videos {each}",
                expected="a folder",
                found="something else" if each.exists() else "nothing",
                todo="Name a folder with videos, as in --videos /data/recordings.",
            )
    given = os.environ.get("PREFECT_API_URL")
    plan = ServePlan(
        project=url,
        inbox=(inbox or Path(url) / "inbox").resolve(),
        videos=tuple(each.resolve() for each in videos or ()),
        bucket=bucket,
        state=folder.folder,
        name=name,
        prefect=(given or f"http://127.0.0.1:{prefect_port}/api").rstrip("/"),
        owns_prefect=not given,
        max_concurrent=max_concurrent,
        dask=dask,
        workers=workers,
        time_limits=dict(parse_time_limits(time_limits or ())),
        host=host,
        names=tuple(names or ()),
        pages_port=port,
        metrics_port=metrics_port,
        certificate=certificate,
        key=key,
        settle_seconds=settle_time,
        poll_minutes=poll_interval,
        gate_hours=gate_hours,
        disk_gb=disk_gb,
        users=None if users is None else users.resolve(),
    )
    access = access_for(host, token=token, names=names or (), secure=tls is not None, users=users)
    secrets = secrets_of(plan, access.token)
    # A token that the operator chose is not printed: the output can go to a log.
    login = "/login" if token or users else f"/login#token={access.token}"
    token_at = "the file --users" if users else PAGES_TOKEN if token else "this address"
    pages = f"{plan.pages}{login}  open it in a browser; the token is in {token_at}"
    serve_all(
        plan,
        secrets,
        lambda: _print_addresses(plan, pages, asks_for_login=secrets.prefect is not None),
        lambda text: line(text, to=errors),
    )


def _print_addresses(plan: ServePlan, pages: str, *, asks_for_login: bool) -> None:
    """Print the addresses, and where secrets are instead of the secrets.

    Args:
        plan: the served project.
        pages: address of the pages, and where its token is.
        asks_for_login: whether Prefect's dashboard asks for a login.
    """
    from flows.orchestration.prefect_environment import CLIENT_LOGIN, SERVER_LOGIN
    from flows.service.service_secrets import METRICS_TOKEN

    variable = SERVER_LOGIN if plan.owns_prefect else CLIENT_LOGIN
    is_kept = plan.owns_prefect and variable not in os.environ
    login_at = plan.state_folder.prefect_login if is_kept else variable
    is_given = METRICS_TOKEN in os.environ
    token_at = METRICS_TOKEN if is_given else plan.state_folder.metrics_token
    line(f"serving {plan.project}")
    line(f"pages          {pages}")
    line(f"status page    {plan.pages}/status")
    line(f"inbox          {plan.inbox}")
    if asks_for_login:
        line(f"Prefect        {plan.dashboard}  its login is in {login_at}")
    else:
        line(f"Prefect        {plan.dashboard}  which asks for no login: others may use it")
    metrics = f"http://{plan.host}:{plan.metrics_port}/metrics"
    line(f"metrics        {metrics}  its token is in {token_at}")
    line("Ctrl-C ends it; the next start resumes")


def _test_alerts(folder: StateFolder, *, as_json: bool) -> None:
    from flows.service.channels import channels_of, send_test

    channels = channels_of(os.environ, folder.alert_settings)
    if not channels:
        raise UsageError(
            "worldpose serve --test-alerts",
            expected=f"a channel in {folder.alert_settings}",
            found="none",
            todo="Write the file as docs/how-to/operations.md says.",
        )
    problems = send_test(channels)
    if as_json:
        print_json({"channels": problems})
    for name, problem in {} if as_json else problems.items():
        line(f"{name}: {f'failed: {problem}' if problem else 'accepted a test alert'}")
    if any(problems.values()):
        raise typer.Exit(1)


def _check(folder: StateFolder, *, as_json: bool) -> None:
    from flows.service.health import check

    findings = check(folder)
    if as_json:
        print_json(
            {
                "healthy": all(finding.is_well for finding in findings),
                "findings": [
                    {"part": it.part, "well": it.is_well, "state": it.state, "mend": it.remedy}
                    for it in findings
                ],
            }
        )
    for finding in [] if as_json else findings:
        line(f"{'ok' if finding.is_well else 'UNHEALTHY':<10}{finding.part}: {finding.state}")
        if not finding.is_well:
            line(f"          fix: {finding.remedy}")
    if not all(finding.is_well for finding in findings):
        raise typer.Exit(1)
