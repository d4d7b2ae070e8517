"""Command serve: continuous processing of a project."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from flows.cli import options
from flows.cli.console import answer, errors, line
from flows.cli.options import DEFAULT_PROJECT
from flows.orchestration.prefect_environment import CLIENT_LOGIN, SERVER_LOGIN
from flows.service.channels import channels_of, send_test
from flows.service.health import check as check_service
from flows.service.layout import StateFolder, state_folder
from flows.service.plan import METRICS_TOKEN, PAGES_TOKEN, ServePlan, parse_schedules, secrets_of
from flows.service.serving import serve as serve_all
from flows.settings import parse_time_limits
from flows.web.access import access_for
from worldpose.errors import UsageError
from worldpose.store.store import open_blobs


def serve(
    inbox: Path | None = None,
    videos: Annotated[list[Path] | None, typer.Option(exists=True, file_okay=False)] = None,
    bucket: str | None = None,
    check: bool = False,
    test_alerts: bool = False,
    max_concurrent: Annotated[int, typer.Option(min=1)] = 1,
    dask: str | None = None,
    workers: int | None = None,
    time_limits: list[str] | None = None,
    name: str = "worldpose",
    port: int = options.PAGES_PORT,
    prefect_port: Annotated[int, typer.Option(min=1, max=65535)] = 4200,
    metrics_port: Annotated[int, typer.Option(min=1, max=65535)] = 8573,
    host: str = "127.0.0.1",
    names: list[str] | None = None,
    certificate: Path | None = None,
    key: Path | None = None,
    settle_time: Annotated[float, typer.Option(min=0)] = 30.0,
    poll_interval: Annotated[float, typer.Option(min=0.1)] = 15.0,
    schedule: Annotated[list[str] | None, typer.Option(metavar="FLOW=CRON")] = None,
    gate_hours: Annotated[float, typer.Option(min=0.001)] = 24.0,
    disk_gb: Annotated[float, typer.Option(min=0)] = 10.0,
    stall_minutes: Annotated[float, typer.Option(min=0.5)] = 10.0,
    history_days: Annotated[float, typer.Option(min=1)] = 30.0,
    state: Path | None = None,
    token: str | None = None,
    users: Path | None = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Serve a project until interrupted: pages, runs, inbox, dashboard, metrics, alerts.

    Open the printed address in a browser: its pages create, calibrate, run, review and show
    matches.

    Alerts go to the channels in PROJECT/operations/secrets/alerts.toml, or of WORLDPOSE_ALERT_URL
    and WORLDPOSE_ALERT_MAIL.
    PREFECT_API_URL names a Prefect server that runs already.

    Example: worldpose serve --inbox /data/arriving

    Options:
        inbox: Folder of arriving matches; PROJECT/inbox by default.
        videos: Folder whose videos people can pick on the pages, read-only; repeatable.
        bucket: s3:// URL of matches to copy to the inbox.
        check: Report problems and their remedies, and exit.
        test_alerts: Send a test alert to every channel, and exit.
        max_concurrent: Matches that run at the same time.
        name: Name of the deployments, unique at a Prefect server.
        prefect_port: Port of Prefect's dashboard on this machine.
        metrics_port: Port of the metrics for Prometheus.
        settle_time: Time without changes until a match counts as complete [s].
        poll_interval: Interval between scans of the inbox [min].
        schedule: When a deployment also runs, as reprocess="0 3 * * *", in this machine's time zone
            or one that follows; repeatable. It stays until it is removed in Prefect's dashboard.
        gate_hours: Age of a pending review that triggers an alert [h].
        disk_gb: Free disk space below which an alert is sent [GB].
        stall_minutes: Time without progress after which a run is ended and restarts [min].
        history_days: Age at which Prefect forgets ended runs [d].
        state: Folder of logs and Prefect's database; PROJECT/operations by default.
    """
    url = open_blobs(project).url
    folder = state_folder(url, state)
    if check:
        _check(folder)
        return
    if test_alerts:
        _test_alerts(folder)
        return
    line(f"starting Prefect, the worker and the pages for {url}", to=errors)
    channels_of(os.environ, folder.alert_settings)  # refused here, not in an unread log
    tls = options.certificate_and_key(certificate, key)
    if inbox is None and "://" in url:
        raise UsageError(
            "--inbox",
            expected="a folder on this machine",
            found="none, and a project on object storage",
            todo="Name a folder, as in --inbox /data/arriving.",
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
        schedules=parse_schedules(schedule) if schedule else {},
        gate_hours=gate_hours,
        disk_gb=disk_gb,
        stall_minutes=stall_minutes,
        history_days=history_days,
        users=None if users is None else users.resolve(),
    )
    access = access_for(host, token=token, names=names or (), secure=tls is not None, users=users)
    secrets = secrets_of(plan, access.token)
    # A token that the operator chose is not printed: the output can go to a log.
    pages = f"{plan.pages}/login{'' if token or users else f'#token={access.token}'}"
    token_at = "the file --users" if users else PAGES_TOKEN if token else "this address"
    serve_all(
        plan,
        secrets,
        lambda: _print_addresses(plan, pages, token_at, asks_for_login=secrets.prefect is not None),
        lambda text: line(text, to=errors),
    )


def _print_addresses(
    plan: ServePlan, pages: str, pages_token_at: str, *, asks_for_login: bool
) -> None:
    """Print the addresses, and where secrets are instead of the secrets."""
    variable = SERVER_LOGIN if plan.owns_prefect else CLIENT_LOGIN
    is_kept = plan.owns_prefect and variable not in os.environ
    login_at = plan.state_folder.prefect_login if is_kept else variable
    is_given = METRICS_TOKEN in os.environ
    token_at = METRICS_TOKEN if is_given else plan.state_folder.metrics_token
    also = "the log-in of the pages opens it; " if plan.owns_prefect else ""
    login = f"{also}its clients' is in {login_at}"
    if not asks_for_login:
        login = "which asks for no login: others may use it"
    told = {
        "pages": pages,
        "status page": f"{plan.pages}/status",
        "inbox": f"{plan.inbox}",
        "Prefect": plan.dashboard,
        "metrics": f"http://{plan.host}:{plan.metrics_port}/metrics",
        **{f"{flow} at": f"{it.cron} {it.timezone}" for flow, it in plan.schedules.items()},
    }
    remarks = {
        "pages": f"open it in a browser; the token is in {pages_token_at}",
        "Prefect": login,
        "metrics": f"its token is in {token_at}",
    }
    lines = (f"{name:<15}{at}  {remarks.get(name, '')}".rstrip() for name, at in told.items())
    end = "Ctrl-C ends it; the next start resumes"
    found = {"project": plan.project, **told, "remarks": remarks}
    answer(found, f"serving {plan.project}", *lines, end)


def _test_alerts(folder: StateFolder) -> None:
    channels = channels_of(os.environ, folder.alert_settings)
    if not channels:
        raise UsageError(
            "worldpose serve --test-alerts",
            expected=f"a channel in {folder.alert_settings}",
            found="none",
            todo="Write the file as docs/how-to/operations.md says.",
        )
    problems = send_test(channels)
    said = {
        name: f"failed: {it}" if it else "accepted a test alert" for name, it in problems.items()
    }
    answer({"channels": problems}, *(f"{name}: {text}" for name, text in said.items()))
    if any(problems.values()):
        raise typer.Exit(1)


def _check(folder: StateFolder) -> None:
    findings = check_service(folder)
    is_healthy = all(finding.is_well for finding in findings)
    lines = []
    for it in findings:
        lines.append(f"{'ok' if it.is_well else 'UNHEALTHY':<10}{it.part}: {it.state}")
        lines += [] if it.is_well else [f"          fix: {it.remedy}"]
    rows = [
        {"part": it.part, "well": it.is_well, "state": it.state, "mend": it.remedy}
        for it in findings
    ]
    answer({"healthy": is_healthy, "findings": rows}, *lines)
    raise typer.Exit(0 if is_healthy else 1)
