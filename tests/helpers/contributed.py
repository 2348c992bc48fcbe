"""The examples in the text of CONTRIBUTING.md."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pfem_petsc import Simulation, open_result

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


def assert_same_results(whole, parts, *fields):
    """The histories and the fields of the last snapshot of two runs agree to the last bit."""
    one, other = open_result(whole), open_result(parts)
    assert list(one.history) == list(other.history)
    for name in one.history:
        assert np.asarray(one.history[name]).tobytes() == np.asarray(other.history[name]).tobytes(), name
    for name in fields:
        assert one.field(name, -1).tobytes() == other.field(name, -1).tobytes(), name
        assert np.abs(one.field(name, -1)).max() > 0.0, name


def run(case, comm, folder, **options):
    with Simulation(case, comm, output=folder, quiet=True, **options) as simulation:
        simulation.run()
        comm.Barrier()
        return simulation
