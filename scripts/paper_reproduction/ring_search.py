"""Search for rings that hit the wall at the times that section 5.3 of the paper gives.

usage: python scripts/paper_reproduction/ring_search.py [--rings 2000] [--file ring_search.json]

Rings of random size, depth, number of bays, bracing and orientation are run with central differences at the large step.
Those whose first contact ends within 1.5 ms of 35 ms and whose second begins within 7 ms of 120 ms are run with
Newmark, Houbolt and Wilson as well, with consistent mass, and are listed with their contact phases.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from paper_reproduction.measures import measure_ring  # noqa: E402
from paper_reproduction.running import read, run_study  # noqa: E402
from paper_reproduction.schemes import LIKELY, SCHEMES  # noqa: E402
from paper_reproduction.studies import RING_STEPS, Study, ring_overrides  # noqa: E402

REFLECTION, SECOND = (0.0335, 0.0365), (0.113, 0.127)  # [s]


def _contact(name: str, settings: tuple[str, ...], folder: Path) -> tuple[list[tuple[float, float]], float]:
    """Contact phases [s] and the largest strain; nothing where the run failed."""
    run_study(Study(name, "ring_impact", settings), folder / name)
    run = read(name, folder)
    if run.failure or not run.history or not (run.history["wall/wall/contacts"] > 0).any():
        return [], 0.0
    ring = measure_ring(run)
    return ring.phases, ring.strain


def main() -> None:
    """Search, tell and keep what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rings", type=int, default=2000, help="rings to try (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--file", type=Path, default=Path("ring_search.json"))
    arguments = parser.parse_args()
    random = np.random.default_rng(arguments.seed)
    step = (f"time.step={RING_STEPS['0.5']!r}", "output.fields_every=50")
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for number in range(arguments.rings):
            bays = int(random.integers(6, 29))
            outer = round(float(random.uniform(5.0, 26.0)), 2)
            inner = round(outer * (1.0 - float(random.uniform(0.015, 0.2))), 2)
            ring = (
                outer,
                inner,
                bays,
                ("x", "single")[int(random.integers(2))],
                ("vertex", "flat")[int(random.integers(2))],
            )
            geometry = ring_overrides(*ring)
            phases, strain = _contact("search", (*SCHEMES["central_differences"].overrides, *geometry, *step), folder)
            if len(phases) < 2:
                continue
            if not REFLECTION[0] <= phases[0][1] <= REFLECTION[1] or not SECOND[0] <= phases[1][0] <= SECOND[1]:
                continue
            entry = {"ring": ring, "central_differences": phases, "strain": {"central_differences": strain}}
            for scheme in ("newmark", "houbolt", "wilson"):
                settings = (*SCHEMES[scheme].overrides, *LIKELY.overrides(scheme), *geometry, *step)
                entry[scheme], entry["strain"][scheme] = _contact("search", settings, folder)
            found.append(entry)
            counts = {scheme: len(entry[scheme]) for scheme in ("newmark", "houbolt", "wilson")}
            print(number, ring, [(round(a * 1e3, 1), round(b * 1e3, 1)) for a, b in phases], counts, flush=True)
            arguments.file.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
