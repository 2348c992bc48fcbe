"""Time and memory of a frame of a film, with lines and with tubes: the table of docs/rendering.md.

    python scripts/frame_times.py                       # 10^5 and 10^6 bars; two minutes, 2 GB of memory
    python scripts/frame_times.py --cells 22 --size 3840x2160

A cubic lattice that falls onto a floor is run for two snapshots. A process for each style draws the second one
repeatedly. The times are those of the fastest frame: the least CPU time, which other load hardly changes, and the least
time by the clock. The load of the machine is printed before and after.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time

STYLES = ("lines", "tubes")
END = 4e-6  # [s], a few steps


def main() -> None:
    """Run the lattices, draw them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[23, 48], metavar="N", help="cells along an edge")
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="of the frame in pixels")
    parser.add_argument("--repeat", type=int, default=7, metavar="N", help="frames that are drawn (default: 7)")
    parser.add_argument("--draw", nargs=2, metavar=("RESULT", "STYLE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    size = tuple(int(part) for part in arguments.size.split("x"))
    if arguments.draw:
        print(json.dumps(drawn(*arguments.draw, size, arguments.repeat)))
        return
    print("load before:", *(f"{load:.2f}" for load in os.getloadavg()))
    print(f"\nframes of {arguments.size}\n\n| bars | style | CPU time [s] | by the clock [s] | memory [MiB] |")
    print("|---|---|---|---|---|")
    for cells in arguments.cells:
        with tempfile.TemporaryDirectory(prefix="frame-times-") as folder:
            changes = ["--set", f"mesh.cells=[{cells},{cells},{cells}]", f"time.end={END}", "output.fields_every=1"]
            _program("-m", "pfem_petsc", "lattice_drop", "-o", folder, "--quiet", *changes)
            for style in STYLES:
                options = ["--size", arguments.size, "--repeat", str(arguments.repeat), "--draw", folder, style]
                found = json.loads(_program(__file__, *options).splitlines()[-1])
                cells_of_row = (f"{found['bars']:,}", style, *(f"{found[key]:.2f}" for key in ("cpu", "clock")))
                print("|", " | ".join(cells_of_row), "|", f"{found['memory']:.0f} |", flush=True)
    print("\nload after:", *(f"{load:.2f}" for load in os.getloadavg()))


def drawn(path: str, style: str, size: tuple[int, int], repeat: int) -> dict[str, float]:
    """Draw a snapshot repeatedly; return the shortest CPU and clock times of a frame [s], and the peak memory [MiB]."""
    from pfem_petsc import open_result
    from pfem_petsc.post.render import Film, Options

    with open_result(path) as result:
        film = Film([result], Options(frames=1, style=style), print)
        film.start(size)
        film.frame(0)  # loads the machine code
        times = []
        for _ in range(repeat):
            cpu, clock = time.process_time(), time.perf_counter()
            film.frame(0)
            times.append((time.process_time() - cpu, time.perf_counter() - clock))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        best = {"cpu": min(each[0] for each in times), "clock": min(each[1] for each in times)}
        film.close()
        return {"bars": len(result.bars), "memory": memory, **best}


def _program(*arguments: str) -> str:
    return subprocess.run([sys.executable, *arguments], check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    main()
