"""Draws the pictures of docs/plotting.md, and of docs/rendering.md.

python scripts/plot_pictures.py            # a minute; the page needs Chromium
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from pages import DOCS, program, save

IMAGES = DOCS / "images"
RUNS = {
    "rod": ["rod_impact"],
    "rod_newmark": ["rod_impact", "--set", "time.integrator=newmark"],
    "ring": ["ring_impact"],
    "30 m per s": ["ring_impact", "--set", "initial.velocity=[30.0,0.0,0.0]"],
    "mast": ["guyed_mast"],
    "path": ["von_mises"],
    "pendulum": ["pendulum"],
    "octet": [
        *("lattice_drop", "--set", "mesh.kind=octet", "mesh.cells=[6,6,6]", "section.strut.area=3e-6"),
        *("initial.velocity=[0.0,0.0,-60.0]", "title=Octet lattice dropped at 60 m/s", "output.fields_every=5"),
    ],
    "lattice": ["lattice_drop", "--set", "mesh.cells=[8,8,8]", "section.strut.area=2e-6"],
}
PLOTS = {
    "plot_energies": ("energies", ["rod"]),
    "plot_walls": ("walls", ["ring", "--filter", "cfc:180"]),
    "plot_path": ("force_displacement", ["path"]),
    "plot_comparison": ("curves", ["rod", "rod_newmark", "--curves", "kinetic_energy", "wall/wall/force.x"]),
    "plot_spectrum": ("spectra", ["pendulum", "--spectrum", "probe/tip/position.x", "--highest", "4"]),
}
RING = ["--ghost", "--mark", "yielded", "--trails", "opposite", "--inset", "kinetic_energy"]
FRAMES = {
    "render_extras": ["ring", *RING, "--frames", "0,50,100,150,200"],
    "render_tubes": ["octet", "--frames", "0,16"],
    "render_loads": ["mast", "--scale", "20", "--field", "axial_force", "--show", "supports", "loads", "--frames", "1"],
    "render_side_by_side": ["ring", "30 m per s", "--labels", "20 m/s", "30 m/s", "--frames", "0,20,130"],
}


def main() -> None:
    """Run the cases, draw them, and write the pictures at the width of a page."""
    with tempfile.TemporaryDirectory(prefix="pictures-") as name:
        folder = Path(name)
        for run, words in RUNS.items():
            program(*words, "-o", run, "--quiet", cwd=folder)
        for target, (picture, words) in PLOTS.items():
            program("plot", *words, "-o", target, cwd=folder)
            save(folder / target / f"{picture}.png", IMAGES / f"{target}.png", width=900)
        for target, words in FRAMES.items():
            options = ["--size", "1280x720", "--video", "none", "--no-poster"]
            program("render", *words, *options, "-o", target, cwd=folder)
            last = sorted((folder / target / "frames").glob("*.png"))[-1]
            save(last, IMAGES / f"{target}.png", width=960)
        browser = shutil.which("chromium") or shutil.which("google-chrome")
        if browser is None:
            print("render_page.png is left as it is: there is no Chromium")
            return
        program("render", "lattice", "--html", "-o", "page", "--frames", "20", cwd=folder)
        page = (folder / "page" / "render.html").as_uri()
        window = ["--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1280,720"]
        window += [f"--screenshot={folder / 'page.png'}", "--enable-unsafe-swiftshader", "--virtual-time-budget=4000"]
        subprocess.run([browser, *window, page], check=True, capture_output=True)
        save(folder / "page.png", IMAGES / "render_page.png", width=960)


if __name__ == "__main__":
    main()
