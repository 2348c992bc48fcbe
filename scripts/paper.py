"""Reproduces the paper's examples: runs, measurements, figures in docs/images/paper, and docs/paper.md.

usage: python scripts/paper.py [--workers 2] [--results results/paper] [--redraw]
Runs take about six minutes on two cores; they are kept, and repeated only if the case or the program changes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from paper_reproduction.claims import measure_all
from paper_reproduction.document import write_document
from paper_reproduction.figures import draw_rods
from paper_reproduction.figures_ring import draw_ring
from paper_reproduction.running import read, run_all
from paper_reproduction.schemes import READINGS
from paper_reproduction.studies import all_studies

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Run, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=2, help="runs at a time (default %(default)s)")
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "paper", help="folder of the runs")
    parser.add_argument(
        "--redraw", action="store_true", help="use the results that are there, whatever has changed since"
    )
    arguments = parser.parse_args()
    if not arguments.redraw:
        run_all(all_studies(), arguments.results, arguments.workers)
    runs = {study.key: read(study.key, arguments.results) for study in all_studies()}
    readings = [measure_all(runs, reading) for reading in READINGS]
    images = ROOT / "docs" / "images" / "paper"
    for file in (*draw_rods(runs, readings, images), *draw_ring(runs, images)):
        print(f"{file.relative_to(ROOT)}  {file.stat().st_size / 1000:.0f} kB")
    for name, counts in write_document(readings, ROOT / "docs" / "paper.md").items():
        print(f"docs/paper.md  {name}: " + ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common()))


if __name__ == "__main__":
    main()
