"""The lock of an output folder: one owner, and locks left behind by kills are recognised."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from pfem_petsc import files as module
from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.files import FolderLock

TAKE = """
import os, sys
from pathlib import Path
from pfem_petsc.files import FolderLock
lock = FolderLock(Path(sys.argv[1]))
lock.take()
print("taken", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "results" / "case"


def owner(folder, **changes):
    """A lock file as another process would have made it."""
    path = FolderLock(folder).path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**module._identity(), **changes}))
    return path


def test_one_owner_at_a_time(folder):
    first, second = FolderLock(folder), FolderLock(folder)
    first.check()
    first.take()
    first.take()
    for refused in (second.take, second.check):
        with pytest.raises(InputError, match=rf"another run is writing.*process {os.getpid()} on .*wait.*-o"):
            refused()
    second.release()
    assert first.path.exists()
    first.release()
    first.release()
    second.take()
    second.release()
    assert list(folder.parent.iterdir()) == []


def test_left_behind_by_a_kill(folder):
    """Taken over while the killed process is not even reaped yet."""
    process = subprocess.Popen(
        [sys.executable, "-c", TAKE, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "taken\n"
    with pytest.raises(InputError, match=f"process {process.pid} on"):
        FolderLock(folder).take()
    process.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    lock = FolderLock(folder)
    lock.check()
    lock.take()
    process.communicate()
    lock.release()


def test_number_of_a_process_that_another_has_now(folder):
    owner(folder, start="1")
    FolderLock(folder).take()


def test_another_machine(folder):
    """Nothing is known of its processes: the message says what to do."""
    path = owner(folder, pid=1, start="1", host="node17", machine="another boot")
    with pytest.raises(InputError, match=rf"if it was killed there, or that machine has restarted, remove {path}"):
        FolderLock(folder).take()
    assert path.exists()


def test_owner_notices_its_loss(folder, monkeypatch):
    monkeypatch.setattr(module, "INTERVAL", 0.0)
    lock = FolderLock(folder)
    lock.take()
    lock.renew()
    owner(folder, token="other")
    with pytest.raises(SimulationFailure, match="removed or taken over"):
        lock.renew()
    lock.release()
    assert lock.path.exists()


@pytest.mark.parametrize("content", ["", "no lock", '{"pid": 1}', "[1]"])
def test_file_without_an_owner(folder, content):
    """Its maker was killed at the wrong moment or is about to write, or it is something else."""
    path = owner(folder)
    path.write_text(content)
    with pytest.raises(InputError, match=f"another run is about to .*, or {path} is no lock .* remove that file"):
        FolderLock(folder).take()
    os.utime(path, (time.time() - 60,) * 2)
    FolderLock(folder).take()


RACE = """
import os, random, sys, time
from pathlib import Path
from pfem_petsc.errors import InputError
from pfem_petsc.files import FolderLock
folder, log = Path(sys.argv[1]), sys.argv[2]
chance = random.Random(int(sys.argv[3]))
for _ in range(60):
    if os.fork() == 0:
        lock = FolderLock(folder)
        try:
            lock.take()
        except InputError:
            os._exit(0)
        alone = os.open(log, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        time.sleep(0.002 * chance.random())
        os.unlink(log)
        if chance.random() < 0.5:
            lock.release()
        os._exit(7)
    status = os.waitstatus_to_exitcode(os.wait()[1])
    assert status in (0, 7), status
    chance.random()
    print(status)
"""


@pytest.mark.slow
def test_many_processes_that_leave_it_behind_are_never_two_at_once(folder, tmp_path):
    """Half of the owners end without giving it back; whoever is second finds the marker of the first and fails."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", RACE, str(folder), str(tmp_path / "alone"), str(seed)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for seed in range(4)
    ]
    said = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0] * 4, said
    assert sum(out.split().count("7") for out, _ in said) > 20
