"""The machines of a project as processes that are killed, disconnected, filled up and restarted.

A Prefect server, a Dask scheduler, and Dask workers on the other side of a network link; the
project lies on a small disk. Links and disks need the rights of root.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import psutil
from page_client import TOKEN
from service import free_ports

from flows.orchestration.prefect_environment import (
    CLIENT_LOGIN,
    SERVER_LOGIN,
    new_login,
    problem_at,
    served_environment,
)
from flows.service.plan import ServePlan

START_SECONDS = 300.0
"""Time limit for starting a process: machines are busy."""


class Link:
    """A network link to a name space of its own, in which workers live; it can be cut."""

    def __init__(self):
        self.space = f"wp-{os.getpid()}"
        self.near, self.far = f"wn{os.getpid()}", f"wf{os.getpid()}"
        net = f"10.213.{os.getpid() % 256}"
        self.here, self.there = f"{net}.1", f"{net}.2"

    def __enter__(self):
        _do("ip", "netns", "add", self.space)
        _do("ip", "link", "add", self.near, "type", "veth", "peer", "name", self.far)
        _do("ip", "link", "set", self.far, "netns", self.space)
        _do("ip", "addr", "add", f"{self.here}/30", "dev", self.near)
        _do("ip", "link", "set", self.near, "up")
        _do("ip", "-n", self.space, "addr", "add", f"{self.there}/30", "dev", self.far)
        _do("ip", "-n", self.space, "link", "set", "lo", "up")
        self.heal()
        return self

    def __exit__(self, *error):
        _do("ip", "netns", "delete", self.space)

    def cut(self):
        _do("ip", "-n", self.space, "link", "set", self.far, "down")

    def heal(self):
        _do("ip", "-n", self.space, "link", "set", self.far, "up")

    def inside(self, command):
        return ["nsenter", f"--net=/var/run/netns/{self.space}", *command]


class Disk:
    """A disk of a few megabytes, which can be full."""

    def __init__(self, folder, megabytes):
        self.folder, self.megabytes = folder, megabytes

    def __enter__(self):
        self.folder.mkdir(parents=True)
        options = f"size={self.megabytes}m"
        _do("mount", "-t", "tmpfs", "-o", options, "worldpose-test", str(self.folder))
        return self

    def __exit__(self, *error):
        _do("umount", "--lazy", str(self.folder))

    def fill(self):
        """Fill the disk, and keep taking the space that other processes free meanwhile."""
        try:
            with (self.folder / "ballast").open("wb") as ballast:
                while True:
                    ballast.write(bytes(1 << 16))
                    ballast.flush()
        except OSError:
            pass

    def free(self):
        (self.folder / "ballast").unlink(missing_ok=True)


class Part:
    """A process with its own process group that can be restarted."""

    def __init__(self, command, environment, log):
        self.command, self.environment, self.log = command, environment, log
        self.process = None

    def start(self):
        with self.log.open("ab") as output:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=self.environment,
                start_new_session=True,
            )

    def is_up(self):
        return self.process is not None and self.process.poll() is None

    def kill(self):
        if self.process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self.process.stdin.close()
            self.process = None

    def kill_child(self):
        """Kill the worker of a nanny; return whether there was one."""
        try:
            children = psutil.Process(self.process.pid).children(recursive=True)
        except psutil.NoSuchProcess:
            return False
        workers = [each for each in children if "spawn_main" in " ".join(each.cmdline())]
        for each in workers:
            each.kill()
        return bool(workers)


class Machines:
    """All that runs of a project use; as a context, they end with it.

    Attributes:
        disk: the folder of the small disk.
        environment: of a `worldpose run` that uses these machines.
        dask: address of the scheduler.
    """

    def __init__(self, folder, workers=2, megabytes=96):
        self.folder, self.workers = folder, workers
        self.link, self.small = Link(), Disk(folder / "disk", megabytes)
        self.disk = self.small.folder
        here = self.link.here
        self.api = f"http://{here}:{free_ports(1)[0]}/api"
        self.dask = f"tcp://{here}:{free_ports(1)[0]}"
        own = {"PREFECT_API_URL": self.api, "PREFECT_HOME": str(folder / "prefect")}
        own[CLIENT_LOGIN] = new_login()
        self.environment = {**os.environ, **own, "NO_PROXY": "*", "no_proxy": "*"}
        self.parts = {}

    def __enter__(self):
        with ExitStack() as stack:
            stack.enter_context(self.link)
            stack.enter_context(self.small)
            stack.callback(self._end)
            for name, command in self._commands().items():
                environment = self.environment
                if name == "prefect":
                    environment = served_environment(self.api, self.folder / "prefect")
                    environment[SERVER_LOGIN] = self.environment[CLIENT_LOGIN]
                    environment["WORLDPOSE_REVIEW_TOKEN"] = TOKEN  # of Prefect's dashboard
                self.parts[name] = Part(command, environment, self.folder / f"{name}.log")
                self.parts[name].start()
            self._wait_until(lambda: not problem_at(f"{self.api}/health"))
            host, port = self.dask.removeprefix("tcp://").split(":")
            self._wait_until(lambda: _listens(host, int(port)))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error):
        self._stack.close()

    def keep_up(self, held=()):
        """Restart the parts that ended, except those in `held`; return their names."""
        ended = [name for name, part in self.parts.items() if not (name in held or part.is_up())]
        for name in ended:
            self.parts[name].kill()
            self.parts[name].start()
        return ended

    def _commands(self):
        python = [sys.executable, "-m"]
        plan = ServePlan(
            project=str(self.disk),
            inbox=self.folder / "inbox",
            state=self.folder / "state",
            prefect=self.api,
        )
        host, port = self.dask.removeprefix("tcp://").split(":")
        scheduler = ["distributed.cli.dask_scheduler", "--host", host, "--port", port]
        worker = ["distributed.cli.dask_worker", self.dask, "--nthreads", "1"]
        worker += ["--host", self.link.there, "--memory-limit", "0", "--no-dashboard"]
        return {
            "prefect": [*python, "flows.service.child", "prefect", plan.model_dump_json()],
            "scheduler": [*python, *scheduler, "--no-dashboard"],
            **{
                f"worker {number}": self.link.inside([*python, *worker])
                for number in range(self.workers)
            },
        }

    def _wait_until(self, is_so):
        deadline = time.monotonic() + START_SECONDS
        while not is_so():
            if time.monotonic() > deadline:
                raise TimeoutError(f"a machine did not begin; see the logs in {self.folder}")
            time.sleep(0.2)

    def mend(self):
        """Lift every fault."""
        self.small.free()
        self.link.heal()
        self.keep_up()

    def _end(self):
        for part in self.parts.values():
            part.kill()


def _do(*command):
    subprocess.run(command, check=True, capture_output=True)


def _listens(host, port):
    with socket.socket() as probe:
        return probe.connect_ex((host, port)) == 0


def may_cut_and_fill():
    """Whether this user may make links and disks."""
    if os.geteuid() != 0:
        return False
    tried = subprocess.run(["unshare", "--net", "--mount", "true"], capture_output=True)
    return tried.returncode == 0 and Path("/usr/bin/nsenter").exists()
