"""The blocks of docs/python.md run one after the other, and do what the page says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "python.md"


def blocks() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_blocks_run(tmp_path):
    """Each on its own would not find what those before have made; warnings are errors."""
    (tmp_path / "page.py").write_text("\n".join(blocks()))
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "page.py"],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert "run  time.step  section.legs.area  status" in done.stdout
    assert int(re.search(r"converged reason (\S+),", done.stdout)[1]) > 0
    difference = re.search(r"difference: (\S+) m", done.stdout)
    assert float(difference[1]) < 1e-12
    assert (tmp_path / "live.png").stat().st_size > 1000 and (tmp_path / "steps.csv").read_text().count("\n") == 5
    assert '\ncase: time.step = "1 ms": expected a number of seconds in SI units' in done.stdout
