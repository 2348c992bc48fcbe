"""Bars that break under static loads, and modes and prestress of what is left."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import AREA, DENSITY, MATERIAL, YOUNG, chain

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import SimulationFailure

STATIC = {"step": 0.1, "max_step": 0.1, "end": 1.0}


def parallel_bars(folder, comm, areas, limits, static, force):
    """Three bars side by side, the outer ones bent out a little, between a foot and a guided tip."""
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]
    from pfem_petsc import write_mesh

    groups = {f"g{k}": np.array([k]) for k in range(3)}
    write_mesh(folder / "bars.h5", points, [[0, 1], [2, 1], [3, 1]], bar_groups=groups, comm=comm)
    materials = {f"m{k}": {**MATERIAL, "rupture": limit} for k, limit in enumerate(limits)}
    sections = {f"s{k}": {"area": area, "material": f"m{k}", "bars": f"g{k}"} for k, area in enumerate(areas)}
    data = {
        "mesh": {"file": "bars.h5"},
        "node_set": {"feet": {"indices": [0, 2, 3]}, "tip": {"indices": [1]}},
        "material": materials,
        "section": sections,
        "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "tip", "fix": "yz"}],
        "load": [{"node_set": "tip", "force": [force, 0.0, 0.0]}],
        "static": static,
        "output": {"fields_every": 1, "probe": [{"name": "tip", "node_set": "tip"}]},
    }
    return Case.from_dict(data, source="bars.toml", folder=folder)


@pytest.mark.parametrize("method", ["newton", "relaxation"])
def test_static_loads_go_on_with_the_bars_that_are_left(method, comm, tmp_path):
    """Stiffness k0 + k1 of a straight bar and two inclined ones; the straight one breaks at its limit."""
    limit = 0.55e-4
    static = {**STATIC, "method": method} if method == "newton" else {"method": method, "step": 0.1, "end": 1.0}
    stiff, inclined = YOUNG * AREA, 2.0 * YOUNG * AREA / np.sqrt(8.0)
    force = 1e-4 * (stiff + inclined)
    case = parallel_bars(
        tmp_path, comm, [AREA] * 3, [{"strain": limit}, {"strain": 1.0}, {"strain": 1.0}], static, force
    )
    history = run(case, tmp_path / "out", comm)
    moved = history["probe/tip/position"][:, 0, 0] - 1.0
    factor = history["load_factor"]
    broken = history["broken_bars"]
    assert broken.tolist() == [0] * 6 + [1] * 5  # 0.6e-4 is the first beyond the limit
    before, after = factor * force / (stiff + inclined), factor * force / inclined
    np.testing.assert_allclose(moved, np.where(broken > 0, after, before), rtol=2e-4, atol=1e-12)
    released = 0.5 * YOUNG * AREA * before[6] ** 2
    np.testing.assert_allclose(history["rupture_dissipation"], np.where(broken > 0, released, 0.0), rtol=1e-3)
    assert np.abs(history["energy_imbalance"]).max() < 1e-8 * history["external_work"][-1]
    status = open_result(tmp_path / "out").field("status", -1)
    assert np.asarray(status).tolist() == [1, 0, 0]


def test_modes_are_those_of_the_bars_that_are_left(comm, tmp_path):
    """f = sqrt(k/m)/2 pi of the inclined bars alone, with the mass of all."""
    stiff, inclined = YOUNG * AREA, 2.0 * YOUNG * AREA / np.sqrt(8.0)
    limits = [{"strain": 0.55e-4}, {"strain": 1.0}, {"strain": 1.0}]
    case = parallel_bars(tmp_path, comm, [AREA] * 3, limits, STATIC, 1e-4 * (stiff + inclined))
    case = Case.from_dict({**case.to_dict(), "modes": {"count": 1}}, folder=tmp_path)
    assert Simulation(case, comm, output=tmp_path / "out", quiet=True).run() == 0
    mass = 0.5 * DENSITY * AREA * (1.0 + 2.0 * np.sqrt(2.0))
    frequency = open_result(tmp_path / "out").modes.frequency
    np.testing.assert_allclose(frequency, np.sqrt(inclined / mass) / (2.0 * np.pi), rtol=5e-4)


def test_static_rupture_cascades_until_none_breaks_or_all_collapses(comm, tmp_path):
    """What the others cannot carry ends the run with the reason; the log has the bars in their order."""
    limits = [{"strain": 0.55e-4}, {"strain": 1e-4}, {"strain": 1e-4}]
    stiff, inclined = YOUNG * AREA, 2.0 * YOUNG * AREA / np.sqrt(8.0)
    case = parallel_bars(tmp_path, comm, [AREA] * 3, limits, STATIC, 1e-4 * (stiff + inclined))
    simulation = Simulation(case, comm, output=tmp_path / "out", quiet=True)
    # without bars the tip is held where it is
    simulation.run()
    assert simulation.row["broken_bars"] == 3
    log = (tmp_path / "out" / "log.txt").read_text()
    assert [log.index(f"bar {k} broke") for k in (0, 1, 2)] == sorted(log.index(f"bar {k} broke") for k in (0, 1, 2))
    assert "strain = 6e-05 >= 5.5e-05" in log
    assert "3 of 3 bars broke" in log


def test_a_mechanism_left_by_rupture_ends_a_static_run_with_the_reason(comm, tmp_path):
    """The first of two bars in a row breaks; the second one, loaded at its end, is held by nothing."""
    case = chain(
        tmp_path,
        comm,
        2,
        [0],
        {"strain": 1e-5},
        None,
        node_set={"foot": {"indices": [0]}, "tip": {"indices": [2]}, "rest": {"indices": [1, 2]}},
        support=[{"node_set": "foot", "fix": "xyz"}, {"node_set": "rest", "fix": "yz"}],
        static={"step": 0.5, "end": 1.0},
        load=[{"node_set": "tip", "force": [1e-4 * YOUNG * AREA, 0.0, 0.0]}],
    )
    with pytest.raises(SimulationFailure, match=r"the rest of the truss finds no equilibrium") as failure:
        Simulation(case, comm, output=tmp_path / "out", quiet=True).run()
    assert "node 1 along (1, 0, 0), with node 2" in str(failure.value)


def test_bars_that_can_break_are_prestressed(comm, tmp_path):
    """The rest length is that of the material as it is at first; the row breaks where the limit is below the stress."""
    for limit, broken in ((2e6, 0), (0.5e6, 1)):
        prestressed = {"area": AREA, "material": "weak", "bars": "weak", "prestress": 1e6}
        case = chain(
            tmp_path,
            comm,
            1,
            [0],
            {"stress": limit},
            {"integrator": "central_differences", "step": 1e-4, "end": 1e-4},
            section={"weak": prestressed},
            support=[{"node_set": "both", "fix": "xyz"}],
            node_set={"both": {"indices": [0, 1]}},
        )
        history = run(case, tmp_path / str(broken), comm)
        assert history["broken_bars"].tolist() == [broken] * 2
