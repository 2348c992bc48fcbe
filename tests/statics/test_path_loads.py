"""Paths under what depends on the load factor: forces, supports, temperatures; bars that yield and unload."""

import numpy as np
import pytest
from helpers.runs import run
from mpi4py import MPI

from pfem_petsc import Case

COMM = MPI.COMM_SELF


def case_of(points, bars, material, area, support, static, **tables):
    """A truss of few nodes, in any consistent units; the node sets are n0, n1, ..."""
    return Case.from_dict(
        {
            "mesh": {"generator": "arrays", "points": points, "bars": bars},
            "node_set": {f"n{k}": {"indices": [k]} for k in range(len(points))},
            "material": {"it": {"density": 1.0, **material}},
            "section": {"it": {"area": area, "material": "it"}},
            "support": support,
            "static": static,
            "output": {
                "fields_every": 0,
                "probe": [{"name": f"n{k}", "node_set": f"n{k}"} for k in range(len(points))],
            },
            **tables,
        }
    )


def down(history, node=0):
    """Displacement of a node along -z."""
    z = history[f"probe/n{node}/position"][:, 0, 2]
    return z[0] - z


class TestVM11:
    """Three bars, elastic and perfectly plastic (Ansys VM11): the middle one of 100 in, the others at 30 degrees."""

    YOUNG, YIELD = 30e6, 30e3

    def case(self, static, load):
        side = 100.0 * np.tan(np.radians(30.0))
        points = [[0, 0, -100], [0, 0, 0], [-side, 0, 0], [side, 0, 0]]
        support = [{"node_set": f"n{k}", "fix": "xyz"} for k in (1, 2, 3)] + [{"node_set": "n0", "fix": "xy"}]
        material = {"young_modulus": self.YOUNG, "law": "elastoplastic", "yield_stress": self.YIELD}
        return case_of(points, [[1, 0], [2, 0], [3, 0]], material, 1.0, support, static, load=[load])

    def force(self, v):
        """Of the node lowered by v for the first time: all bars stretch."""
        rest = 100.0 / np.cos(np.radians(30.0))
        length = np.hypot(rest * 0.5, 100.0 + v)
        stress = [
            np.minimum(self.YOUNG * (now / l0 - 1.0), self.YIELD) for now, l0 in ((100.0 + v, 100.0), (length, rest))
        ]
        return stress[0] + 2.0 * stress[1] * (100.0 + v) / length

    def test_load_and_unload(self, tmp_path):
        """By increments of a load that rises beyond first yield and goes back to zero."""
        table = [[0.0, 0.0], [1.0, 51961.5], [2.0, 81961.5], [3.0, 0.0]]
        load = {"node_set": "n0", "force": [0.0, 0.0, -1.0], "table": table}
        history = run(self.case({"method": "newton", "step": 0.1, "end": 3.0}, load), tmp_path / "a", COMM)
        v, factor = down(history), history["load_factor"]
        assert np.interp(1.0, factor, v) == pytest.approx(0.07533, abs=1e-4)
        top = v[np.argmin(np.abs(factor - 2.0))]
        assert self.force(top) == pytest.approx(81961.5, rel=1e-8)
        # unloading is elastic in all bars
        middle = self.YIELD - self.YOUNG * (top - v[-1]) / 100.0
        assert middle == pytest.approx(-5650.0, rel=5e-3)
        assert history["probe/n1/reaction"][-1, 0, 2] == pytest.approx(middle, rel=1e-8)
        assert history["plastic_dissipation"][-1] > 0.0

    @pytest.mark.parametrize("method", ["displacement", "arc_length"])
    def test_path_beyond_the_yielding_of_all_bars(self, method, tmp_path):
        """Load over displacement on the closed form, up to twice the displacement at which all bars have yielded."""
        static = {"method": method, "node_set": "n0", "direction": [0, 0, -1], "step": 0.1, "displacement": 0.27}
        load = {"node_set": "n0", "force": [0.0, 0.0, -80e3]}
        history = run(self.case(static, load), tmp_path / "a", COMM)
        v = down(history)
        np.testing.assert_allclose(80e3 * history["load_factor"], self.force(v), rtol=1e-8)
        assert v[-1] == pytest.approx(0.27, rel=1e-9)
        assert (v > 0.14).sum() >= 2


def test_vm4(tmp_path):
    """Ansys VM4, small displacements: two bars of 180 in at 30 degrees below their supports, 10,000 psi, 0.12 in."""
    x, z = 180.0 * np.cos(np.radians(30.0)), 90.0
    support = [{"node_set": "n1", "fix": "xyz"}, {"node_set": "n2", "fix": "xyz"}, {"node_set": "n0", "fix": "y"}]
    load = [{"node_set": "n0", "force": [0.0, 0.0, -5000.0]}]
    case = case_of(
        [[0, 0, -z], [-x, 0, 0], [x, 0, 0]],
        [[0, 1], [0, 2]],
        {"young_modulus": 30e6},
        0.5,
        support,
        {"end": 1.0},
        load=load,
    )
    history = run(case, tmp_path / "a", COMM)
    v = down(history)[-1]
    length = np.hypot(x, z + v)
    stress = 30e6 * (length / 180.0 - 1.0)
    assert 2.0 * 0.5 * stress * (z + v) / length == pytest.approx(5000.0, rel=1e-8)
    assert v == pytest.approx(0.120, rel=2e-3)
    assert stress == pytest.approx(10000.0, rel=2e-3)


ARCH = [[0, 0, 0.1], [-1, 0, 0], [1, 0, 0]]
FEET = [{"node_set": "n1", "fix": "xyz"}, {"node_set": "n2", "fix": "xyz"}, {"node_set": "n0", "fix": "xy"}]
FOLLOWED = {"node_set": "n0", "direction": [0.0, 0.0, -1.0]}
EA, L0 = 1e5, np.sqrt(1.01)


def arch(static, support=FEET, **tables):
    material = {"young_modulus": 1e9, **tables.pop("material", {})}
    static = {"method": "arc_length", "step": 0.05, **FOLLOWED, **static}
    return case_of(ARCH, [[0, 1], [0, 2]], material, 1e-4, support, static, **tables)


def arch_force(z, half_span=1.0, free=L0):
    """Downward force that holds the apex at a height, with bars of a free length."""
    length = np.hypot(half_span, z)
    return -2.0 * EA * (length - free) / L0 * z / length


@pytest.mark.parametrize("method", ["arc_length", "displacement"])
def test_feet_that_move_apart_pull_the_apex_down(method, tmp_path):
    """No load at all: the load factor is the way of a foot, and the apex is where the bars are straight."""
    rows = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.02, 0.0, 0.0]]
    support = [
        {"node_set": "n1", "fix": "xyz"},
        {"node_set": "n2", "fix": "xyz", "motion": rows, "interpolation": "linear"},
    ]
    support.append({"node_set": "n0", "fix": "y"})
    load = [{"node_set": "n0", "force": [0.0, 0.0, -1.0], "table": [[0.0, 0.0], [1e-9, 1.0]]}]
    case = arch({"method": method, "displacement": 0.06}, support, load=load)
    history = run(case, tmp_path / "a", COMM)
    z, factor = history["probe/n0/position"][:, 0, 2], history["load_factor"]
    np.testing.assert_allclose(history["probe/n2/position"][:, 0, 0], 1.0 + 0.02 * factor, atol=1e-13)
    np.testing.assert_allclose(history["probe/n0/position"][:, 0, 0], 0.01 * factor, atol=1e-10)
    np.testing.assert_allclose(arch_force(z, 1.0 + 0.01 * factor)[1:], 1.0, atol=1e-6)
    assert z[-1] == pytest.approx(0.04, abs=1e-9)


@pytest.mark.slow
def test_temperature_as_the_load(tmp_path):
    """Cooled bars under a constant load: the load factor is a temperature, and has a limit point."""
    load = [{"node_set": "n0", "force": [0.0, 0.0, -1.0], "table": [[0.0, 10.0], [1.0, 10.0]]}]
    temperature = [{"table": [[-100.0, 2000.0], [100.0, -2000.0]]}]
    case = arch({"displacement": 0.08}, load=load, temperature=temperature, material={"thermal_expansion": 1e-5})
    history = run(case, tmp_path / "a", COMM)
    z, factor = history["probe/n0/position"][:, 0, 2], history["load_factor"]
    free = L0 * (1.0 - 1e-5 * 20.0 * factor)
    np.testing.assert_allclose(arch_force(z, free=free)[1:], 10.0, atol=1e-5)
    # the first point is the equilibrium under what acts at load factor zero
    assert factor[1] == 0.0
    assert z[1] < 0.1
    limits = history["event/load_factor"][history["event/kind"] == "limit"]
    heights = np.linspace(0.002, 0.0999, 200001)
    length = np.hypot(1.0, heights)
    strain = 10.0 * length / (2.0 * EA * heights)
    factors = (1.0 - (length + strain * L0) / L0) / (1e-5 * 20.0)
    assert limits[0] == pytest.approx(factors.max(), rel=1e-6)


def test_gravity_as_the_load(tmp_path):
    """The arch under its own weight: half of each bar's mass is at the apex."""
    mass = 1e-4 * L0 * 1.0
    case = arch({"displacement": 0.06}, gravity={"acceleration": [0.0, 0.0, -100.0 / mass]})
    history = run(case, tmp_path / "a", COMM)
    z = history["probe/n0/position"][:, 0, 2]
    np.testing.assert_allclose(100.0 * history["load_factor"], arch_force(z), atol=1e-7)
