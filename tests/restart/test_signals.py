"""Signals from the start of the program, and their handlers after a run."""

import gc
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.kills import PATIENCE, command, processes_of
from helpers.launch import environment

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.signals import SIGNALS

ENDLESS = ["rod_impact", "--quiet", "--set", "time.end=1e5", "-o"]


def takes_signals(pid):
    """Whether a process has a handler of its own for SIGHUP, as the program has from its first moment on."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    caught = int(next(line for line in status.splitlines() if line.startswith("SigCgt")).split()[1], 16)
    return bool(caught >> (signal.SIGHUP - 1) & 1)


def wait_for(condition, process):
    while not condition():
        assert process.poll() is None
        time.sleep(0.002)


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2])
def test_two_interrupts_during_start_up(tmp_path, ranks):
    """Before anything is imported: no traceback, no rank that hangs, and a checkpoint at the first occasion."""
    process = subprocess.Popen(
        command(ranks, *ENDLESS, tmp_path / "out"), env=environment(), stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: len(pids := processes_of(process, ranks)) == ranks and all(map(takes_signals, pids)), process)
    for _ in range(2):
        for pid in processes_of(process, ranks):
            os.kill(pid, signal.SIGINT)
        time.sleep(0.05)
    said = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == 4, said
    assert said.count("stopped: SIGINT received; step 0 is finished") == 1
    assert "Traceback" not in said
    assert (tmp_path / "out" / "checkpoint.h5").is_file()


@pytest.mark.slow
def test_terminal_that_is_closed(tmp_path):
    """SIGHUP, and nothing can be printed any more: the checkpoint is written, the status is that of a stop."""
    out = tmp_path / "out"
    words = [word for word in command(1, *ENDLESS, out) if word != "--quiet"]
    inside, outside = pty.openpty()
    process = subprocess.Popen(
        ["setsid", "--ctty", "--wait", *words], env=environment(), stdin=outside, stdout=outside, stderr=outside
    )
    os.close(outside)
    while not (out / "result.vtkhdf").exists():
        assert process.poll() is None
        os.read(inside, 4096)
    os.close(inside)
    assert process.wait(timeout=PATIENCE) == 4
    with open_result(out) as result:
        assert "SIGHUP" not in result.attributes  # it opens
    assert (out / "checkpoint.h5").is_file()


def test_verb_without_steps_is_interrupted_at_once():
    """What came before the verb was known is not lost, and there is no traceback."""
    code = (
        "import signal, sys; from pfem_petsc.signals import watch_early; watch_early(); "
        "signal.raise_signal(signal.SIGINT); from pfem_petsc.cli.main import main; sys.exit(main(['info', '.']))"
    )
    done = subprocess.run([*command(1)[:1], "-c", code], env=environment(), capture_output=True, text=True, timeout=200)
    assert done.returncode == 3
    assert done.stderr == "stopped: interrupted; no checkpoint was written\n"


@pytest.fixture
def handlers():
    """The handlers of a program that has its own."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    own = {number: lambda *_: None for number in SIGNALS}
    for number, handler in own.items():
        signal.signal(number, handler)
    yield own
    for number, handler in before.items():
        signal.signal(number, handler)


def mine(handlers):
    return {number: signal.getsignal(number) for number in SIGNALS} == handlers


def simulation(tmp_path, **options):
    return Simulation(Case.load("rod_impact", ["time.end=0.05"]), output=tmp_path / "out", quiet=True, **options)


@pytest.mark.parametrize("end", ["run", "close", "exception", "gone", "left"])
def test_handlers_are_given_back(tmp_path, handlers, end):
    one = simulation(tmp_path)
    if end == "run":
        one.run()
    elif end == "exception":
        one.on_step(lambda step: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            one.run()
    elif end == "left":
        for _ in one:
            assert not mine(handlers)
            break
    else:
        one.start()
        assert not mine(handlers)
        if end == "close":
            one.close()
        del one
        gc.collect()
    assert mine(handlers)
    assert not (tmp_path / "out.lock").exists()


@pytest.mark.slow
def test_reader_of_the_output_that_exits(tmp_path):
    """As in ``python -m pfem_petsc CASE | head -1``: the run goes on."""
    words = command(1, "rod_impact", "-o", tmp_path / "out", "--set", "time.end=0.5")
    process = subprocess.Popen(words, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.readline()
    process.stdout.close()
    said = process.stderr.read()
    assert process.wait(timeout=PATIENCE) == 0, said
    assert open_result(tmp_path / "out").history["time"][-1] == pytest.approx(0.5)


@pytest.mark.slow
@pytest.mark.parametrize("ignored", [False, True])
def test_hang_up_while_petsc_starts(ignored):
    """PETSc's own handler would end the process, also under nohup."""
    code = (
        "import os, signal; from pfem_petsc.signals import early, watch_early; watch_early(); "
        "from pfem_petsc.cli.main import start_petsc; start_petsc([], 0); "
        "os.kill(os.getpid(), signal.SIGHUP); print('signal', early()._signal)"
    )
    words = [*(["nohup"] if ignored else []), sys.executable, "-c", code]
    done = subprocess.run(words, env=environment(), capture_output=True, text=True, timeout=PATIENCE)
    assert done.stdout.split()[-2:] == ["signal", "0" if ignored else str(int(signal.SIGHUP))], done.stderr


def test_ignored_hang_up_stays_ignored(tmp_path, handlers):
    """As under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    one = simulation(tmp_path)
    one.start()
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    one.close()
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
