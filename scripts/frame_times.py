"""Time and memory of a frame of a film, with lines and with tubes: the table of docs/rendering.md.

    python scripts/frame_times.py                       # 10^5 and 10^6 bars; some minutes, 2 GB of memory
    python scripts/frame_times.py --cells 22 --size 3840x2160

A cubic lattice that falls onto a floor is run for some snapshots, which ``render`` draws: once the first two, and once
all. A frame takes the difference over the number of frames, PNG included: of CPU time, which other load hardly changes,
and of time by the clock. The load of the machine is printed before and after.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pages import program

STEP = 1e-6  # [s]


def main() -> None:
    """Run the lattices, draw them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[23, 48], metavar="N", help="cells along an edge")
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="of the frame in pixels")
    parser.add_argument("--repeat", type=int, default=7, metavar="N", help="frames that are timed (default: 7)")
    arguments = parser.parse_args()
    print("load before:", *(f"{load:.2f}" for load in os.getloadavg()))
    print(f"\nframes of {arguments.size}\n\n| cells | style | CPU time [s] | by the clock [s] | memory [MiB] |")
    print("|---|---|---|---|---|")
    for cells in arguments.cells:
        with tempfile.TemporaryDirectory(prefix="frame-times-") as folder:
            changes = [f"mesh.cells=[{cells},{cells},{cells}]", f"time.step={STEP}"]
            changes += [
                f"time.end={STEP * (arguments.repeat + 1)}",
                "output.fields_every=1",
                'output.fields=["stress"]',
            ]
            program("lattice_drop", "-o", folder, "--quiet", "--set", *changes)
            for style in ("lines", "tubes"):
                begin = [drawn(Path(folder), style, arguments.size, 2) for _ in range(2)][1]  # machine code is there
                end = drawn(Path(folder), style, arguments.size, arguments.repeat + 2)
                cpu, clock = ((b - a) / arguments.repeat for a, b in zip(begin[:2], end))
                print(f"| {cells} | {style} | {cpu:.2f} | {clock:.2f} | {end[2]:.0f} |", flush=True)
    print("\nload after:", *(f"{load:.2f}" for load in os.getloadavg()))


def drawn(folder: Path, style: str, size: str, frames: int) -> tuple[float, float, float]:
    """Draw the first snapshots; return CPU and clock time [s], and the peak memory [MiB], of the program."""
    options = ["--style", style, "--size", size, "--video", "none", "--no-poster", "--field", "stress"]
    numbers = ",".join(map(str, range(frames)))
    line = ["render", folder, "-o", folder / "pictures", *options, "--frames", numbers]
    clock = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "pfem_petsc", *line], stdout=subprocess.DEVNULL)
    _, _, used = os.wait4(process.pid, 0)
    return used.ru_utime + used.ru_stime, time.perf_counter() - clock, used.ru_maxrss / 1024.0


if __name__ == "__main__":
    main()
