"""A SLURM cluster of one node: this machine, as two cores and two GPUs that are none; munged, slurmctld and slurmd, in a folder of their own."""

from __future__ import annotations

import getpass
import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
CLIENTS = ("sbatch", "srun", "squeue", "scancel", "scontrol", "sinfo")
SBIN = "/usr/local/sbin:/usr/sbin:/sbin"

# No cgroups, no accounting: what a container has. The node is what is said here, whatever the machine is.
CONFIGURATION = """
ClusterName=sluice
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={daemon}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerType=sched/builtin
SchedulerParameters=batch_sched_delay=0,sched_interval=2
SlurmdParameters=config_overrides
ReturnToService=2
MinJobAge=3600
GresTypes=gpu
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 Sockets=1 CoresPerSocket=2 ThreadsPerCore=1 RealMemory=32000 Gres=gpu:2 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


class NoCluster(Exception):
    """Why there is no cluster here."""


class Cluster:
    """``environment`` is what a program needs to find it. Raises ``NoCluster``."""

    def __init__(self, folder: Path):
        self.folder, self.daemons = folder, []
        path = f"{os.environ['PATH']}:{SBIN}"
        self._programs = {name: shutil.which(name, path=path) for name in (*DAEMONS, *CLIENTS)}
        missing = [name for name, place in self._programs.items() if place is None]
        if missing:
            raise NoCluster(f"no {', '.join(missing)}: apt-get install slurm-wlm munge")
        # The plugin's job step starts srun without SLURM_CONF, which only clusters need whose configuration is in no usual place.
        wrapper = folder / "bin" / "srun"
        wrapper.parent.mkdir()
        wrapper.write_text(f'#!/bin/sh\nSLURM_CONF={folder}/slurm.conf exec {self._programs["srun"]} "$@"\n')
        wrapper.chmod(0o755)
        self.environment = {"SLURM_CONF": str(folder / "slurm.conf"), "PATH": f"{wrapper.parent}:{path}"}
        try:
            self._start()
        except BaseException:
            self.stop()
            raise

    def _start(self) -> None:
        folder, host = self.folder, socket.gethostname().split(".")[0]
        with socket.socket() as one, socket.socket() as two:
            one.bind(("127.0.0.1", 0))
            two.bind(("127.0.0.1", 0))
            ports = {"controller": one.getsockname()[1], "daemon": two.getsockname()[1]}
        (folder / "slurm.conf").write_text(CONFIGURATION.format(folder=folder, host=host, user=getpass.getuser(), **ports))
        (folder / "gres.conf").write_text(f"NodeName={host} Name=gpu File=/dev/tty[0-1]\n")
        (folder / "munge.key").write_bytes(os.urandom(128))
        (folder / "munge.key").chmod(0o400)
        for name in ("state", "spool"):
            (folder / name).mkdir()
        places = [f"--{option}={folder}/munge.{option.split('-')[0]}" for option in ("key-file", "socket", "pid-file", "seed-file")]
        # By force, since the folder is closed to other users.
        self._daemon("munged", "--foreground", "--force", "--num-threads=10", *places)
        self._wait(lambda: (folder / "munge.socket").exists(), "munged opens no socket")
        self._daemon("slurmctld", "-D")
        self._daemon("slurmd", "-D")
        self._wait(lambda: self.ask("sinfo", "--noheader", "--format=%t").strip() == "idle", "the node does not come up")

    def _daemon(self, name: str, *arguments: str) -> None:
        with open(self.folder / f"{name}.log", "w") as log:
            command = [self._programs[name], *arguments]
            self.daemons.append((name, subprocess.Popen(command, env=os.environ | self.environment, stdout=log, stderr=log, start_new_session=True)))

    def _wait(self, ready, fault: str) -> None:
        deadline = time.monotonic() + 30
        while not ready():
            ended = [name for name, process in self.daemons if process.poll() is not None]
            if ended or time.monotonic() > deadline:
                name = (ended or [self.daemons[-1][0]])[0]
                lines = (self.folder / f"{name}.log").read_text().strip().splitlines()[-3:]
                raise NoCluster(f"{fault}{'; ' + name + ' ended' if ended else ''}: {' / '.join(lines)}")
            time.sleep(0.1)

    def ask(self, program: str, *arguments: str) -> str:
        """The output of one of SLURM's programs."""
        answer = subprocess.run([program, *arguments], env=os.environ | self.environment, capture_output=True, text=True, timeout=30)
        return answer.stdout

    def stop(self) -> None:
        """End all jobs, then the daemons."""
        if len(self.daemons) == len(DAEMONS):
            self.ask("scancel", f"--user={getpass.getuser()}")
            deadline = time.monotonic() + 20
            while self.ask("squeue", "--noheader") and time.monotonic() < deadline:
                time.sleep(0.2)
        for _, process in reversed(self.daemons):
            process.terminate()
        for _, process in self.daemons:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
