"""A hundred case and mesh files with random mistakes; scripts/endurance.py tries thousands."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent.parent / "scripts" / "endurance.py"


@pytest.mark.slow
def test_mistakes_are_refused_with_a_message(tmp_path):
    """In a process of its own, which a mesh file might end. The same mutants in every run."""
    line = [sys.executable, str(SCRIPT), "mutants", "100", "--seed", "1000", "--folder", str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "100 mutants from seed 1000: 0 bad" in done.stdout
