"""The examples in the text of CONTRIBUTING.md."""

from __future__ import annotations

import re
from pathlib import Path

from pfem_petsc import Simulation

TEXT = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text()
PACKAGES = (
    *("integrators", "contact.walls", "contact.constraints", "mesh.generators", "mechanics.materials"),
    *("contact.treatments", "formats", "statics.methods"),
)
EXAMPLES = {
    path: code
    for code, path in re.findall(
        r"^```(?:python|toml)\n(# pfem_petsc/(\S+)\n.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL
    )
}


def run(case, comm, folder, **options):
    with Simulation(case, comm, output=folder, quiet=True, **options) as simulation:
        simulation.run()
        comm.Barrier()
        return simulation
