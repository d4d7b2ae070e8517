"""The batch job under SLURM itself: its own daemons on this machine, as two nodes."""

import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from worldpose.store.store import Store

BATCH = Path(__file__).parents[2] / "infra" / "slurm" / "dask.sbatch"
PROGRAMS = os.environ.get("PATH", "") + ":/usr/sbin"
CONTROLLER = shutil.which("slurmctld", path=PROGRAMS)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(
        CONTROLLER is None or os.geteuid() != 0, reason="SLURM is not installed, or no root"
    ),
]


@pytest.fixture
def slurm(tmp_path):
    host = socket.gethostname().partition(".")[0]
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    folder = tmp_path / "slurm"
    for name in ("state", "n1", "n2"):
        (folder / name).mkdir(parents=True)
    plugins = Path(CONTROLLER).resolve().parents[1] / "lib" / "x86_64-linux-gnu" / "slurm-wlm"
    (folder / "slurm.conf").write_text(
        f"""ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/none
CredType=cred/none
PluginDir={plugins}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
SlurmctldPidFile={folder}/controller.pid
SlurmdPidFile={folder}/%n.pid
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/%n
SlurmdParameters=config_overrides
NodeName=DEFAULT CPUs=2 RealMemory=8000
NodeName=n[1-2] NodeHostname={host} NodeAddr=127.0.0.1 Port=[{port + 1}-{port + 2}]
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
    )
    path = f"{Path(sys.executable).parent}:{PROGRAMS}"
    environment = {**os.environ, "PATH": path, "SLURM_CONF": str(folder / "slurm.conf")}
    environment.pop("PREFECT_API_URL", None)
    programs = Path(CONTROLLER).resolve().parent
    node = [shutil.which("slurmd", path=PROGRAMS), "-D", "-d", next(programs.glob("slurmstepd*"))]
    commands = [[CONTROLLER, "-D"], [*node, "-N", "n1"], [*node, "-N", "n2"]]
    said = folder / "said.txt"
    with said.open("wb") as output:
        streams = {"stdout": output, "stderr": output}
        processes = [subprocess.Popen(each, env=environment, **streams) for each in commands]
    wait_for(lambda: ask(environment, "sinfo", "-ho", "%A") == "0/2", 60, said.read_text)  # idle
    yield environment
    for process in reversed(processes):
        process.terminate()
        process.wait(60)


def ask(environment, *command):
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    return done.stdout.strip()


def wait_for(is_so, seconds, explain=str):
    deadline = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < deadline, explain()
        time.sleep(1.0)


def test_a_job_computes_a_match_on_two_nodes_and_goes_on_when_it_is_requeued(
    slurm, small_match, tmp_path
):
    said, project = tmp_path / "job.txt", tmp_path / "project"
    asked = ["--parsable", "-N2", "--ntasks-per-node=1", "--mem-per-cpu=1G", "-o", str(said)]
    job = ask(slurm, "sbatch", *asked, "--open-mode=append", BATCH, small_match, project)
    assert job.isdigit()

    def text():
        return said.read_text() if said.exists() else ""

    wait_for(lambda: " static_calibration/cam" in text(), 900, text)
    # As when a node fails: the job restarts automatically.
    subprocess.run(["scontrol", "requeue", job], env=slurm, check=True)
    state = ["scontrol", "show", "job", job]
    wait_for(lambda: "JobState=COMPLETED" in ask(slurm, *state), 1200, text)
    assert "Restarts=1 " in ask(slurm, *state)
    store = Store.open(str(project))
    (match,) = store.matches()
    record = store.run(match)
    assert (record.state, record.failed) == ("complete", ())
    assert any(name.startswith("ingest/") for name in record.reused)
    assert "body_fitting/clip" in record.executed
    assert list((project / "operations").iterdir()) == []
