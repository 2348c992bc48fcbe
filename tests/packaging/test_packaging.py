"""Recipes of the folder packaging: the Slurm script in a queue that is made up, lists of dependencies and data."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from pfem_petsc import open_result
from pfem_petsc.cli.main import _parse

ROOT = Path(__file__).parents[2]
PACKAGING = ROOT / "packaging"


@pytest.fixture
def queue(tmp_path):
    """Submit the job: srun runs its command here, or ends with the status of FAKE; scontrol notes what it is told."""
    tools = tmp_path / "tools"
    tools.mkdir()
    srun = (
        '#!/bin/bash\nif [[ -n ${FAKE:-} ]]; then exit "$FAKE"; fi\n'
        f'while [[ $1 == --* || $1 == python ]]; do shift; done\nexec "{sys.executable}" "$@"\n'
    )
    (tools / "srun").write_text(srun)
    (tools / "scontrol").write_text(f'#!/bin/bash\necho "$@" >> {tmp_path}/scontrol\nexit "${{REFUSE:-0}}"\n')
    for tool in tools.iterdir():
        tool.chmod(0o755)

    def submit(*words, **variables):
        environment = {**os.environ, "PATH": f"{tools}:{os.environ['PATH']}", "SLURM_JOB_ID": "77", **variables}
        environment["PYTHONPATH"] = str(ROOT)
        done = subprocess.run(
            ["bash", str(PACKAGING / "slurm_requeue.sh"), *words],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
        )
        told = tmp_path / "scontrol"
        return done, told.read_text().split("\n")[:-1] if told.exists() else []

    return submit


@pytest.mark.slow
def test_a_job_that_is_stopped_is_queued_again_and_continues(queue, tmp_path):
    job = ("rod_impact", "out", "--set", "time.end=0.5")
    stopped, told = queue(*job, "--wall-time", "0.001")
    assert stopped.returncode == 0 and told == ["requeue 77"], stopped.stderr
    assert "stopped with a checkpoint in out: queued again" in stopped.stdout
    assert open_result(tmp_path / "out").history["time"][-1] < 0.5
    done, told = queue(*job, SLURM_RESTART_COUNT="1")
    assert done.returncode == 0 and told == ["requeue 77"], done.stderr
    assert "the run in out is done" in done.stdout
    assert open_result(tmp_path / "out").history["time"][-1] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("variables", "status", "queued", "text"),
    [
        ({"FAKE": "3"}, 3, 0, "failed with status 3: not queued again"),
        ({"FAKE": "2"}, 2, 0, "failed with status 2"),
        ({"FAKE": "143"}, 143, 0, "failed with status 143"),
        ({"FAKE": "4", "SLURM_RESTART_COUNT": "100"}, 4, 0, "after 100 restarts: not queued again"),
        ({"FAKE": "4", "REFUSE": "1"}, 4, 1, "submit it once more"),
    ],
)
def test_other_ends_of_a_job(queue, variables, status, queued, text):
    done, told = queue("rod_impact", "out", **variables)
    assert done.returncode == status and len(told) == queued
    assert text in done.stderr


def test_conda_environment_has_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {re.match(r"[\w-]+", text)[0].lower() for text in project["dependencies"]}
    listed = re.findall(r"^  - ([\w-]+)", (PACKAGING / "environment.yml").read_text(), flags=re.MULTILINE)
    names = {name.removesuffix("-base") for name in listed}
    assert wanted <= names


def test_data_files_are_in_the_wheel():
    """Everything of the package that git has, and that is no module, matches a pattern of the package data."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    for path in (ROOT / "pfem_petsc").rglob("*"):
        if path.is_dir() or path.suffix in (".py", ".pyc", ".nbc", ".nbi"):
            continue
        package = ".".join(path.parent.relative_to(ROOT).parts)
        assert any(path.match(pattern) for pattern in project.get(package, ())), path


def test_set_up_compiles_what_the_first_commands_need():
    """Loops of runs and of drawing; the commands of setup.sh are accepted."""
    text = (ROOT / "scripts" / "setup.sh").read_text().replace("\\\n", " ")
    text = re.sub(r'"\$folder/(\w+)"', r"\1", text)
    commands = re.findall(r'"\$python" -m pfem_petsc ([^\n&|>]*)', text)
    cases = {"rod_impact", "lattice_drop", "hanging_net"}
    assert {command.split()[0] for command in commands} == {"bench", "render", *cases}
    for command in commands:
        _parse(shlex.split(command))


@pytest.mark.parametrize("linked", [False, True])
def test_an_environment_of_another_checkout_is_left_alone(tmp_path, linked):
    """Also where this checkout has a link to it."""
    text = (ROOT / "scripts" / "setup.sh").read_text()
    (function,) = re.findall(r"^make_venv\(\) \{\n.*?^\}\n", text, re.MULTILINE | re.DOTALL)
    other, venv = tmp_path / "other", tmp_path / "venv"
    other.mkdir()
    venv.mkdir()
    (venv / "made-from").write_text(f"{other} distribution /usr/bin/python3")
    given = venv
    if linked:
        given = tmp_path / "own" / ".venv"
        given.parent.mkdir()
        given.symlink_to(venv)
    given = f'root="{tmp_path}/own" venv="{given}" python=false\nfail() {{ echo "$*" >&2; exit 1; }}\nsay() {{ :; }}\n'
    code = f"{given}foundation() {{ echo changed; }}\n{function}\nmake_venv false"
    done = subprocess.run(["bash", "-euc", code], capture_output=True, text=True)
    assert done.returncode == 1 and f"belongs to the checkout {other}" in done.stderr
    assert (venv / "made-from").read_text().startswith(str(other))


def of_setup(*names, code):
    """Run shell code with functions of setup.sh."""
    text = (ROOT / "scripts" / "setup.sh").read_text()
    functions = [re.findall(rf"^{name}\(\) (?:\{{.*?^\}}|\{{[^\n]*\}})$", text, re.M | re.S)[0] for name in names]
    return subprocess.run(["bash", "-euc", "\n".join([*functions, code])], capture_output=True, text=True)


@pytest.mark.parametrize(
    ("output", "told"),
    [
        ("connection broken by 'NewConnectionError(...): Failed to establish a new connection'", "check the network"),
        ("W: Failed to fetch http://a/b  Temporary failure resolving\nCould not resolve 'a'", "check the network"),
        ("OSError: [Errno 28] No space left on device: 'numba'", "the disk is full: make room"),
        ("E: Could not get lock /var/lib/dpkg/lock-frontend. It is held by process 7", "wait until it has ended"),
        ("Error: [Errno 13] Permission denied: '/opt/venv/bin'", "another folder by PFEM_VENV"),
        ("error: something else", ""),
    ],
)
def test_a_set_up_that_fails_says_why(tmp_path, output, told):
    (tmp_path / "log").write_text(output)
    found = of_setup("cause", code=f'cause "{tmp_path}/log"').stdout.strip()
    assert (told in found) if told else found == ""
    code = f'fail() {{ echo "setup: $*" >&2; exit 1; }}\nfailed "{tmp_path}/log" "pip install all"'
    done = of_setup("cause", "failed", code=code)
    assert done.returncode == 1 and done.stderr.startswith(output)
    assert "setup: failed: pip install all" in done.stderr and told in done.stderr


@pytest.mark.parametrize(("status", "signal"), [(0, ""), (1, ""), (1, "TERM")])
def test_a_set_up_that_ends_early_names_the_environment(tmp_path, status, signal):
    """And how to go on; what it was made from stays, so that the program can name it too."""
    ending = f"kill -s {signal} $$" if signal else f"exit {status}"
    code = f'root="{tmp_path}" venv="{tmp_path}/.venv" log="{tmp_path}/log"\ntouch "$log"\n'
    code += f'trap ended EXIT\ntrap "fail stopped by SIGTERM" TERM\n{ending}'
    done = of_setup("fail", "ended", code=code)
    assert done.returncode == status and not (tmp_path / "log").exists()
    lines = ["setup: stopped by SIGTERM"] if signal else []
    lines += ["setup: the environment .venv is not finished: the same command goes on from there"] if status else []
    assert done.stderr.splitlines() == lines


def test_scripts_are_valid_shell():
    for script in (*PACKAGING.glob("*.sh"), *(ROOT / "scripts").glob("*.sh")):
        subprocess.run(["bash", "-n", str(script)], check=True)
