"""Runs that are stopped by the wall time or a signal, and continued."""

import functools
import os
import re
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from helpers.kills import KINDS, command, differences, processes_of
from helpers.launch import environment
from helpers.stopped import steps

from pfem_petsc.cli.main import main
from pfem_petsc.output.result import open_result


@pytest.mark.slow
def test_wall_time(tmp_path, capsys):
    folder = tmp_path / "slow"
    words = ["rod_impact", "-o", str(folder), "--quiet", "--set", "time.end=1000"]
    assert main([*words, "--wall-time", "0.5"]) == 4
    said = capsys.readouterr().err
    assert said.startswith("stopped: the wall time of 0.50 s has elapsed")
    assert "continue with --restart" in said
    reached = steps(folder)[0][-1]
    assert 0 < reached < 100_000
    # over before the first step, which is made nevertheless
    assert main([*words, "--restart", "--wall-time", "1e-9"]) == 4
    rows = steps(folder)[0]
    assert rows[-1] > reached
    np.testing.assert_array_equal(rows, range(rows[-1] + 1))


@pytest.mark.slow
def test_message_has_the_command_that_continues(tmp_path, capsys):
    """Run as it stands, but for the wall time; a value with blanks and quotes comes back whole."""
    folder = tmp_path / "a folder"
    title = 'title="It\'s  two"'
    words = ["rod_impact", "-o", str(folder), "--quiet", "--set", title, "time.end=0.6", "output.fields_every=3"]
    assert main([*words, "--wall-time", "1e-9"]) == 4
    line = capsys.readouterr().err.strip().splitlines()[-1]
    pasted = shlex.split(line)
    assert pasted[:3] == ["python", "-m", "pfem_petsc"]
    at = pasted.index("--wall-time")
    del pasted[at : at + 2]
    assert main(pasted[3:]) == 0
    rows, snapshots = steps(folder)
    np.testing.assert_array_equal(rows, range(61))
    np.testing.assert_array_equal(snapshots, range(0, 61, 3))
    with open_result(folder) as result:
        assert result.case.title == "It's  two"


def test_checkpoints_by_the_clock(tmp_path):
    """Due whenever the ranks meet: after the first step, and at the end."""
    folder = tmp_path / "minutes"
    assert (
        main(["rod_impact", "-o", str(folder), "--quiet", "--set", "time.end=0.1", "output.checkpoint_minutes=1e-9"])
        == 0
    )
    assert (folder / "checkpoint-previous.h5").is_file()


STOPPED = KINDS["explicit contact, plastic"]
STOPPED_WORDS = [STOPPED.case, "--quiet", "--set", *STOPPED.overrides, "time.end=2e-4", "-o"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The result of the case that is stopped by signals, on a number of ranks."""

    @functools.cache
    def result(ranks):
        folder = tmp_path_factory.mktemp("undisturbed")
        line = command(ranks, *STOPPED_WORDS, folder)
        done = subprocess.run(line, env=environment(), capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return folder / "result.vtkhdf"

    return result


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ranks", "number", "whom"),
    [
        (1, signal.SIGTERM, "last rank"),
        (1, signal.SIGINT, "last rank"),
        (1, signal.SIGUSR1, "last rank"),
        (2, signal.SIGTERM, "last rank"),
        (2, signal.SIGTERM, "all ranks"),
        (2, signal.SIGUSR1, "launcher"),
    ],
)
def test_signal_stops_with_a_checkpoint_and_the_restart_is_bitwise(tmp_path, undisturbed, ranks, number, whom):
    """To the ranks, as a batch system sends it, or to the launcher, which passes this one on."""
    folder = tmp_path / "stopped"
    line = command(ranks, *STOPPED_WORDS, folder)
    status, said = signalled(line, ranks, folder, number, whom)
    assert status == 4, said
    assert f"stopped: {signal.Signals(number).name} received" in said
    assert said.count("stopped: ") == 1
    done = subprocess.run([*line, "--restart"], env=environment(), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert differences(folder / "result.vtkhdf", undisturbed(ranks)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_launcher_that_ends_its_ranks_leaves_them_time_for_a_checkpoint(tmp_path, number):
    """It sends them SIGTERM, and has a status of its own.

    The launcher of Open MPI kills its ranks one second after SIGTERM, whether they have finished or not. On a busy
    machine they may need longer, and are given more time; each start waits for the whole of it.
    """
    for seconds in (1, 5, 25):
        folder = tmp_path / f"stopped {seconds}"
        line = [*command(2, *STOPPED_WORDS, folder), "--set=output.fields_every=1000"]
        patience = {f"{kind}_MCA_odls_base_sigkill_timeout": str(seconds) for kind in ("OMPI", "PRTE")}
        status, said = signalled([*line, "--set=time.end=1.0"], 2, folder, number, "launcher", patience)
        if "stopped: " in said:
            break
    assert status not in (0, 2, 3), said
    assert said.count("stopped: SIGTERM received") == 1
    reached = int(re.search(r"step (\d+) is finished", said).group(1))
    line.append(f"--set=time.end={(reached + 50) * 5e-7}")
    done = subprocess.run([*line, "--restart"], env=environment(), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(steps(folder)[0], range(reached + 51))


def signalled(line, ranks, folder, number, whom, variables=None):
    """Run until the first step, send a signal: exit status and stderr."""
    process = subprocess.Popen(line, env=environment() | (variables or {}), stderr=subprocess.PIPE, text=True)
    while not (folder / "log.txt").exists() and process.poll() is None:
        time.sleep(0.01)
    pids = processes_of(process, ranks)
    for pid in {"last rank": pids[-1:], "all ranks": pids, "launcher": [process.pid]}[whom]:
        os.kill(pid, number)
    said = process.communicate(timeout=300)[1]
    return process.returncode, said


@pytest.mark.slow
def test_third_interrupt_ends_at_once(tmp_path):
    """Also where the others are not looked at any more: here in a step that never ends."""
    script = tmp_path / "stuck.py"
    script.write_text(
        "import ctypes, sys\n"
        "from pfem_petsc import Case, Simulation\n"
        "from pfem_petsc.stepping.explicit import ExplicitStepper\n"
        "def stuck(self):\n"
        "    print('stuck', flush=True)\n"
        "    while ctypes.CDLL(None).sleep(100): pass\n"
        "ExplicitStepper.step = stuck\n"
        f"Simulation(Case.load('rod_impact'), output={str(tmp_path / 'out')!r}, quiet=True).run()\n"
    )

    process = subprocess.Popen(
        [sys.executable, str(script)], env=environment(), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout.readline() == "stuck\n"
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=100) == -signal.SIGINT
    process.stdout.close()
