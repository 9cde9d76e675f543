"""A Slurm cluster of this machine alone, for a test: private in a temporary folder, except slurm.conf.

Slurm must read /etc/slurm/slurm.conf, since Snakemake's jobs do not get SLURM_CONF. No init system starts
anything, so the cluster also works in a container.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

CONF = Path("/etc/slurm/slurm.conf")
POLICY = Path("/usr/sbin/policy-rc.d")  # of Debian: whether packages may start services
PACKAGES = ("slurm-wlm", "munge")
DAEMONS = ("slurmctld", "slurmd", "munged")
PATIENCE_S = 60.0  # for a daemon to answer
# Slurm forgets jobs after MinJobAge; Snakemake asks for them later than that otherwise.
SETTINGS = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory_mb}
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/affinity
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
ReturnToService=2
MinJobAge=3600
SlurmdTimeout=5
"""


class SkippedError(Exception):
    """The test cannot run here; the message says why."""


def check_machine() -> None:
    """Refuse a machine where the cluster cannot be started, or that has one.

    Raises
    ------
    SkippedError
    """
    if os.geteuid() != 0:
        raise SkippedError("it needs root, to install and to start Slurm")
    if CONF.exists():
        raise SkippedError(f"{CONF} exists; the test would have to replace it")
    if running := [name for name in DAEMONS if _processes(name)]:
        raise SkippedError(f"{running[0]} is running; the test starts its own")
    with suppress(OSError):
        socket.gethostbyname(_host())
        return
    raise SkippedError(f"the name of this machine, {_host()}, has no address; add it to /etc/hosts")


def install() -> bool:
    """Install Slurm from the packages of the distribution; return whether that was necessary.

    Raises
    ------
    SkippedError
        They cannot be installed here.
    """
    if all(shutil.which(name) for name in DAEMONS):
        return False
    if not shutil.which("apt-get"):
        raise SkippedError(
            f"the packages {' and '.join(PACKAGES)} are missing, and there is no apt-get"
        )
    quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    with _no_services():
        for words in (["update"], ["install", "--yes", "--no-install-recommends", *PACKAGES]):
            command = ["apt-get", "--quiet", *words]
            done = subprocess.run(command, env=quiet, capture_output=True, text=True)
            if done.returncode:
                raise SkippedError(f"`{' '.join(command)}` failed: {done.stderr.strip()}")
    return True


@contextmanager
def _no_services() -> Iterator[None]:
    """Let packages start no daemon at their installation."""
    if POLICY.exists():
        yield
        return
    POLICY.write_text("#!/bin/sh\nexit 101\n", encoding="utf-8")
    POLICY.chmod(0o755)
    try:
        yield
    finally:
        POLICY.unlink()


@dataclass
class Cluster:
    """A running cluster. Its daemons are the only ones of this machine."""

    folder: Path

    def start_node(self) -> None:
        subprocess.run(["slurmd"], check=True)
        _wait_for("the node", lambda: "idle" in _output("sinfo", "--noheader", "--format", "%t"))

    def kill_node(self) -> int:
        """Kill the node's daemon and all processes of its jobs at once; return how many jobs there were.

        It is as if the machine lost its power. Slurm notices after SlurmdTimeout.
        """
        steps = _processes("slurmstepd")
        family = [child for step in steps for child in step.children(recursive=True)]
        jobs = _output("squeue", "--noheader", "--states=R", "--format=%i").split()
        for process in [*_processes("slurmd"), *steps, *family]:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        return len(jobs)

    def wait_until_down(self) -> None:
        _wait_for("the loss of the node", lambda: "down" in _output("sinfo", "-h", "-o", "%t"))

    def jobs(self) -> list[str]:
        """Return the jobs that are pending or running."""
        return _output("squeue", "--noheader", "--format=%i %T").splitlines()


@contextmanager
def cluster() -> Iterator[Cluster]:
    """Start a cluster; stop it and remove its files at the end."""
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    folder.chmod(0o755)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    existed = CONF.parent.is_dir()
    CONF.parent.mkdir(parents=True, exist_ok=True)
    CONF.write_text(_settings(folder), encoding="utf-8")
    try:
        _start_munge(folder)
        subprocess.run(["slurmctld"], check=True)
        _wait_for("slurmctld", lambda: "UP" in _output("scontrol", "ping"))
        running = Cluster(folder)
        running.start_node()
        yield running
    finally:
        _stop()
        CONF.unlink()
        if not existed:
            CONF.parent.rmdir()
        shutil.rmtree(folder, ignore_errors=True)


def _settings(folder: Path) -> str:
    stated = dict(re.findall(r"(\w+)=(\S+)", _output("slurmd", "-C")))
    return SETTINGS.format(
        host=_host(), cpus=stated["CPUs"], memory_mb=stated["RealMemory"], folder=folder
    )


def _start_munge(folder: Path) -> None:
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    files = {"key-file": key, "socket": folder / "munge.socket"}
    files |= {f"{kind}-file": folder / f"munge.{kind}" for kind in ("pid", "log", "seed")}
    subprocess.run(["munged", *(f"--{name}={path}" for name, path in files.items())], check=True)


def _stop() -> None:
    """End the jobs first, so that none survives the daemons."""
    with suppress(subprocess.SubprocessError, OSError):
        subprocess.run(["scancel", "--user=root"], timeout=10, capture_output=True)
        subprocess.run(["scontrol", "shutdown"], timeout=10, capture_output=True)
    ending = [each for name in ("slurmstepd", *DAEMONS) for each in _processes(name)]
    ending += [child for each in ending for child in each.children(recursive=True)]
    _, alive = psutil.wait_procs(_signalled(ending, signal.SIGTERM), timeout=10)
    psutil.wait_procs(_signalled(alive, signal.SIGKILL), timeout=10)


def _signalled(processes: list[psutil.Process], number: int) -> list[psutil.Process]:
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.send_signal(number)
    return processes


def _processes(name: str) -> list[psutil.Process]:
    return [each for each in psutil.process_iter(["name"]) if each.info["name"] == name]


def _wait_for(what: str, is_there: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not is_there():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what}: not there after {PATIENCE_S:.0f} s")
        time.sleep(0.5)


def _output(*command: str) -> str:
    """Return what a command prints; nothing, if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    return done.stdout if done.returncode == 0 else ""


def _host() -> str:
    return socket.gethostname().partition(".")[0]
