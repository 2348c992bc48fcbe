"""The shallow two-bar arch: equilibrium path, limit load and snap-through by slow and sudden loads."""

import numpy as np
import pytest
from helpers.runs import run

from pfem_petsc import Case

HALF_SPAN, RISE, YOUNG, AREA, DENSITY = 1.0, 0.1, 1e9, 1e-4, 1000.0
REST = np.hypot(HALF_SPAN, RISE)
LIMIT = 2 * YOUNG * AREA * (1 - (HALF_SPAN / REST) ** (2 / 3)) ** 1.5

ARCH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$Nodes
3
1 -1.0 0 0
2 0 0 0.1
3 1.0 0 0
$EndNodes
$Elements
2
1 1 2 1 1 1 2
2 1 2 1 1 2 3
$EndElements
"""


def arch(folder, **tables):
    (folder / "arch.msh").write_text(ARCH)
    return Case.from_dict(
        {
            "mesh": {"file": "arch.msh"},
            "node_set": {"feet": {"indices": [0, 2]}, "apex": {"indices": [1]}},
            "material": {"it": {"young_modulus": YOUNG, "density": DENSITY, **tables.pop("material", {})}},
            "section": {"it": {"area": AREA, "material": "it"}},
            "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "apex", "fix": "xy"}],
            "output": {"fields_every": 0, "probe": [{"name": "apex", "node_set": "apex"}]},
            "time": {"integrator": "central_differences", "step": 1e-5, "end": 1.0},
            **tables,
        },
        folder=folder,
    )


def path(z):
    """Downward load [N] that holds the apex at height z [m]."""
    return 2 * YOUNG * AREA * z * (1 / np.hypot(HALF_SPAN, z) - 1 / REST)


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "snaps"), [(0.98, False), (1.02, True)])
def test_slow_load_snaps_through_at_the_limit(factor, snaps, tmp_path):
    """A load that grows slowly to 98 % of the limit is borne, to 102 % it is not; damping keeps the motion slow."""
    case = arch(
        tmp_path,
        material={"damping": 2e5},
        load=[{"node_set": "apex", "force": [0.0, 0.0, -factor * LIMIT], "table": [[0.0, 0.0], [1.0, 1.0]]}],
        time={"integrator": "central_differences", "step": 4e-4, "end": 3.0},
    )
    z = run(case, tmp_path / "it")["probe/apex/position"][:, 0, 2]
    assert (z[-1] < -RISE) == snaps
    if not snaps:
        assert path(z[-1]) == pytest.approx(factor * LIMIT, rel=1e-3)


@pytest.mark.parametrize(("factor", "snaps"), [(0.98, False), (1.02, True)])
def test_sudden_load_snaps_through_at_its_own_limit(factor, snaps, tmp_path):
    """Without damping: critical when U(z) = P (h - z) at the unstable equilibrium, found here by bisection."""

    def energy(z):
        return YOUNG * AREA * REST * (np.hypot(HALF_SPAN, z) / REST - 1) ** 2

    def passes(load):
        z = np.linspace(RISE, -RISE, 20001)
        return (energy(z) - load * (RISE - z)).max() <= 0.0

    low, high = 0.1 * LIMIT, LIMIT
    while high - low > 1e-6 * LIMIT:
        low, high = (low, 0.5 * (low + high)) if passes(0.5 * (low + high)) else (0.5 * (low + high), high)
    load = factor * high
    case = arch(
        tmp_path,
        load=[{"node_set": "apex", "force": [0.0, 0.0, -load]}],
        time={"integrator": "central_differences", "step": 5e-5, "end": 0.2},
    )
    z = run(case, tmp_path / "it")["probe/apex/position"][:, 0, 2]
    assert (z.min() < -0.5 * RISE) == snaps
