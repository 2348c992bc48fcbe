"""How tests are started: the environment of processes, and which tests run without ``--all-sets``."""

from __future__ import annotations

import os
import subprocess
import zlib
from collections import defaultdict
from pathlib import Path

import pytest

OF_A_LAUNCH = (
    *("PMIX_", "PMI_", "OPAL_", "ORTE_", "OMPI_COMM_", "OMPI_APP_", "OMPI_UNIVERSE_"),
    *("OMPI_MCA_orte_", "OMPI_MCA_ess", "OMPI_MCA_pmix"),
)
"""Variables that MPI sets in the environment of a process and that would confuse another launch."""


def environment() -> dict[str, str]:
    """Return the environment of a process without a launcher."""
    variables = {
        name: value for name, value in os.environ.items() if not name.startswith((*OF_A_LAUNCH, "PYTEST_XDIST_"))
    }
    allowed = ("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "OMPI_MCA_rmaps_base_oversubscribe")
    variables |= dict.fromkeys((*allowed, "OMPI_MCA_mpi_yield_when_idle", "OMP_NUM_THREADS"), "1")
    return variables | {"PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe"}


STRIDE = {1: 10, 2: 8}
"""Of sets of parameters that are kept, by number of ranks; 12 on more."""
FEWER = 4
"""Factor on the stride for tests marked ``few_sets``."""


PARTS = 8
"""Of the slow tests; one part runs without ``--all-sets``."""


def part_of_commit(folder: Path) -> int:
    """Return the part of the slow tests that is due at the present commit, the next one after the next commit; the
    first where there is no repository."""
    git = ["git", "-C", str(folder), "rev-list", "--count", "HEAD"]
    try:
        count = subprocess.run(git, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return 0
    return int(count) % PARTS


def refuse_repeated_names(folder: Path) -> None:
    """Raise ``pytest.UsageError`` if two test files in the folders below have the same name."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in sorted(folder.rglob("test_*.py")):
        found[path.name].append(path.relative_to(folder.parent).as_posix())
    repeated = [paths for paths in found.values() if len(paths) > 1]
    if repeated:
        lines = "\n".join(f"  {' and '.join(paths)}" for paths in repeated)
        raise pytest.UsageError(
            f"test files of the same name:\n{lines}\n"
            "pytest imports test files by their names alone, whatever their folders: rename all but one of each line"
        )


def thinned(items: list[pytest.Item], ranks: int, part: int) -> list[pytest.Item]:
    """Return a part of the slow tests and all others except the thorough ones, with some of their sets of parameters.

    Tests with several sets run with every tenth of them (eighth on two ranks, twelfth on three), tests marked
    ``few_sets`` with a quarter of these. Of the parallel tests one half runs on two ranks, the other on three.
    """
    sets: dict[tuple[Path, str], list[pytest.Item]] = {}
    for item in items:
        function = getattr(item, "originalname", item.name)
        other = zlib.crc32(f"{item.path.name} {function}".encode()) % PARTS != part
        if item.get_closest_marker("thorough") is None and not (other and item.get_closest_marker("slow") is not None):
            sets.setdefault((item.path, function), []).append(item)
    chosen: set[pytest.Item] = set()
    for group in list(sets.values())[ranks % 2 :: 2] if ranks > 1 else list(sets.values()):
        if len(group) > 1:
            every = STRIDE.get(ranks, 12) * (FEWER if group[0].get_closest_marker("few_sets") is not None else 1)
            group = group[(ranks - 1) % min(every, len(group)) :: every]
        chosen |= set(group)
    return [item for item in items if item in chosen]
