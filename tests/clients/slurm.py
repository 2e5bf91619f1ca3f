"""A temporary Slurm cluster of one machine, for a check.

The cluster has the same daemons as a large one: munge, slurmctld and slurmd. They are processes of this
check, use free ports, and have their files in one folder. The check neither starts nor uses a service of the
system. It needs root, because slurmd switches to the users of jobs.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

CONF = """
ClusterName=check
SlurmctldHost={host}(127.0.0.1)
AuthType=auth/munge
# A job that is requeued waits as long as the credential of its last run may live.
AuthInfo=socket={folder}/munge.socket,cred_expire=5
SlurmUser=root
SlurmdUser=root
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=0,sched_interval=5,bf_interval=1
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
# Two tasks at a time, however many cores there are.
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=10 State=UP
"""


@contextmanager
def cluster(folder):
    """Starts the cluster, yields the environment for its commands, and then ends all its processes."""
    folder.mkdir(parents=True)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    host = socket.gethostname().split(".")[0]
    (folder / "slurm.conf").write_text(CONF.format(folder=folder, host=host, ports=free_ports(2)))
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o600)
    # Debian installs daemons in folders that are in the PATH of root only.
    path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
    environment = {**os.environ, "PATH": path, "SLURM_CONF": str(folder / "slurm.conf")}
    # Exit normally on SIGTERM, so that the daemons are ended, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    munged = ["munged", "--foreground", "--force", f"--key-file={key}", f"--socket={folder}/munge.socket"]
    munged += [f"--{name}-file={folder}/munge.{name}" for name in ("pid", "log", "seed")]
    daemons = []
    try:
        for command in (munged, ["slurmctld", "-D"], ["slurmd", "-D"]):
            log = (folder / f"{command[0]}.out").open("wb")
            daemons.append(
                subprocess.Popen(
                    command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
                )
            )
            if command is munged:
                wait_until(lambda: (folder / "munge.socket").exists(), 20, "munged has no socket")
        wait_until(lambda: "idle" in ask(environment, "sinfo", "--noheader", "--format=%T"), 60, "no node is idle")
        yield environment
    except BaseException:
        for log in sorted(folder.glob("*.out")):
            print(f"  -- the end of {log}:", *log.read_text(errors="replace").splitlines()[-15:], sep="\n     ", file=sys.stderr)
        raise
    finally:
        end(daemons, folder)


def ask(environment, *command):
    """The output of a Slurm command; empty if it fails."""
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    return ran.stdout if ran.returncode == 0 else ""


def wait_until(is_so, seconds, what):
    """Waits until a condition holds; raises an error after this time."""
    deadline = time.monotonic() + seconds
    while not is_so():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what} after {seconds} s")
        time.sleep(0.1)


def free_ports(count):
    """Returns the numbers of free TCP ports."""
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def end(daemons, folder):
    """Ends the daemons, the last started first, and the remaining processes of their jobs."""
    for daemon in reversed(daemons):
        daemon.terminate()
        try:
            daemon.wait(10)
        except subprocess.TimeoutExpired:
            daemon.kill()
            daemon.wait()
    # Jobs continue by design when slurmd ends. Only they have this configuration in their environment, so it
    # finds them.
    mark = f"SLURM_CONF={folder}/slurm.conf".encode()
    for pid in pids():
        if pid != os.getpid() and mark in environment_of(pid):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass


def pids():
    """The ids of all running processes."""
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]


def environment_of(pid):
    """The environment of a process, one entry per variable; empty if the process has ended."""
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return []
