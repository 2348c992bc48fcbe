"""Three hundred case and mesh files with random mistakes; scripts/endurance.py tries thousands."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent.parent / "scripts" / "endurance.py"


@pytest.mark.slow
def test_mistakes_are_refused_with_a_message(tmp_path):
    """In a process of its own, which a mesh file might end. The same mutants in every run."""
    line = [sys.executable, str(SCRIPT), "mutants", "300", "--seed", "1000", "--folder", str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "300 mutants from seed 1000: 0 bad" in done.stdout


def test_mutants_are_mutants(tmp_path):
    """Most of them are refused: else the test above would not try much."""
    import random

    from helpers.files import mutated_bytes, mutated_text, small_cases

    from pfem_petsc import Case
    from pfem_petsc.errors import InputError

    texts, chance, refused = small_cases(), random.Random(1), 0
    for _ in range(100):
        text = chance.choice(texts)
        assert mutated_bytes(text.encode(), random.Random(7)) != text.encode()
        try:
            Case.from_toml(mutated_text(text, chance), tmp_path, source="case.toml")
        except InputError as error:
            refused += 1
            assert str(error).startswith("case.toml: ")
    assert 40 < refused < 95
