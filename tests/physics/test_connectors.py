"""Springs and dashpots between two nodes, against closed forms and bars of the same stiffness."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import case_of

from pfem_petsc import Case, Simulation, open_result, write_mesh
from pfem_petsc.errors import InputError

EXPLICIT = ["central_differences", "chung_lee", "hulbert_chung", "souza_moura"]
IMPLICIT = ["newmark", "wilson", "houbolt", "generalized_alpha", "energy_momentum"]
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}
MASS, K, C = 0.4, 900.0, 3.0  # of each of two rigid bars [kg], [N/m], [N s/m]


def two_bars(folder, comm, connections, scheme=None, step=1e-3, end=0.25, mass="lumped", speed=0.2, **tables):
    """Two stiff bars along x in a line, 1 m apart, that move towards each other along x."""
    time = {"time": {"integrator": scheme, "step": step, "end": end, "mass": mass, **PARAMETERS.get(scheme, {})}}
    sets = {"one": [0, 1], "two": [2, 3], "a": [1], "b": [2], "far": [3], "root": [0]}
    velocity = [{"node_set": "one", "velocity": [speed, 0, 0]}, {"node_set": "two", "velocity": [-speed, 0, 0]}]
    data = {
        "node_set": {name: {"indices": numbers} for name, numbers in sets.items()},
        "material": {"m": {"young_modulus": 2e8, "density": MASS / 0.5 / 1e-3}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "output": {"fields_every": 0, "probe": [{"name": name, "node_set": name} for name in ("a", "b")]},
        "solver": {"rtol": 1e-13},
        **({"initial": {"on": velocity}} if speed else {}),
        **connections,
        **(time if scheme else {}),
        **tables,
    }
    points = [[0.0, 0, 0], [0.5, 0, 0], [1.5, 0, 0], [2.0, 0, 0]]
    return case_of(folder, comm, points, [[0, 1], [2, 3]], **data)


SPRING = {"spring": [{"between": ["a", "b"], "stiffness": K}]}
DASHPOT = {"dashpot": [{"between": ["a", "b"], "coefficient": C}]}


def gap(history):
    return history["probe/b/position"][:, 0, 0] - history["probe/a/position"][:, 0, 0]


def centres(history):
    return history["centre_of_mass"]


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", [*EXPLICIT, *IMPLICIT])
def test_vibration_of_two_masses(scheme, mass, comm, shared_tmp_path):
    """Relative motion x = v/w sin(w t) with w^2 = 2 k/m; energies, momentum and angular momentum balance."""
    step = 1e-3 if scheme in IMPLICIT else 2e-4
    history = run(two_bars(shared_tmp_path, comm, SPRING, scheme, step, mass=mass), shared_tmp_path / "out", comm)
    omega = np.sqrt(2.0 * K / MASS)
    exact = 1.0 - 0.4 / omega * np.sin(omega * history["time"])
    loose = {"souza_moura": 0.1, "houbolt": 0.06, "wilson": 0.03}.get(scheme, 0.02)
    assert np.abs(gap(history) - exact).max() < loose * 0.4 / omega
    scale = history["kinetic_energy"][0]
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * scale
    assert np.abs(history["momentum"]).max() < 1e-12 * MASS * 0.2
    assert history["elastic_energy"].max() > 0.9 * scale
    if scheme == "energy_momentum":
        assert np.abs(history["numerical_dissipation"]).max() < 1e-11 * scale
    assert np.abs(centres(history) - [1.0, 0.0, 0.0]).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", [*EXPLICIT, *IMPLICIT])
def test_dashpot_between_two_masses(scheme, mass, comm, shared_tmp_path):
    """The relative velocity decays as exp(-2 c t/m); what is lost is viscous dissipation."""
    step = 1e-3 if scheme in IMPLICIT else 2e-4
    history = run(two_bars(shared_tmp_path, comm, DASHPOT, scheme, step, mass=mass), shared_tmp_path / "out", comm)
    rate = 2.0 * C / MASS
    exact = 1.0 - 0.4 / rate * (1.0 - np.exp(-rate * history["time"]))
    loose = {"souza_moura": 0.03, "houbolt": 0.015}.get(scheme, 0.012)
    assert np.abs(gap(history) - exact).max() < loose * 0.4 / rate
    scale = history["kinetic_energy"][0]
    lost = scale - history["kinetic_energy"] - history["elastic_energy"]
    assert np.abs(lost - history["viscous_dissipation"] - history["numerical_dissipation"]).max() < 1e-11 * scale
    assert history["viscous_dissipation"][-1] > 0.9 * (1.0 - np.exp(-2.0 * rate * 0.25)) * scale
    assert np.abs(history["momentum"]).max() < 1e-12 * MASS * 0.2


@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
@pytest.mark.parametrize("method", ["newton", "relaxation", "arc_length"])
def test_static_deflection_and_modes(method, operator, comm, shared_tmp_path):
    """A bar that hangs on another by a spring: F/k besides the stretch of the bars."""
    if method != "newton" and operator == "matrix_free":
        pytest.skip("one operator is enough")
    force = 20.0
    case = two_bars(
        shared_tmp_path,
        comm,
        SPRING | {"dashpot": [{"between": ["a", "b"], "coefficient": C}]},
        speed=0.0,
        static={"step": 0.5, "method": method} | ({"max_points": 3} if method == "arc_length" else {}),
        support=[{"node_set": "one", "fix": "yz"}, {"node_set": "two", "fix": "yz"}, {"node_set": "root", "fix": "x"}],
        load=[{"node_set": "far", "force": [force, 0.0, 0.0]}],
        modes={"count": 1},
        solver={"rtol": 1e-11, "operator": operator, "linear": "cg" if operator == "matrix_free" else "auto"},
    )
    history = run(case, shared_tmp_path / "out", comm)
    assert gap(history) == pytest.approx(1.0 + history["load_factor"] * force / K, rel=1e-9)
    if comm.rank == 0:
        stiff = 2e8 * 1e-3 / 0.5
        found = open_result(shared_tmp_path / "out").modes.frequency[0]
        chain = np.diag([MASS, 0.5 * MASS, 0.5 * MASS])  # of the lumped masses of nodes 1, 2, 3
        chain[0, 0] = 0.5 * MASS
        matrix = np.array([[stiff + K, -K, 0.0], [-K, K + stiff, -stiff], [0.0, -stiff, stiff]])
        lowest = np.sqrt(np.linalg.eigvals(np.linalg.solve(chain, matrix)).real.min())
        assert found == pytest.approx(lowest / (2.0 * np.pi), rel=1e-3)


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "generalized_alpha"])
def test_equals_a_bar_of_the_same_stiffness_in_large_motion(scheme, comm, shared_tmp_path):
    """On ranks: springs of stiffness E A/L, in place of bars whose mass is at the nodes instead."""
    points = np.array([[0, 0, 0], [1.0, 0, 0], [1.1, 0.9, 0.2], [0.1, 1, 0], [0.5, 0.4, 0.8]])
    kept, other = [[0, 1], [1, 2], [2, 3], [3, 0], [0, 4]], [[4, 1], [2, 4]]
    step = {"central_differences": 2e-4, "generalized_alpha": 1e-3}[scheme]
    stiff, rho, area = 1e5, 300.0, 1e-3
    tables = {
        "node_set": {f"n{k}": {"indices": [k]} for k in range(5)} | {"all": {"all": True}},
        "material": {
            "m": {"young_modulus": stiff, "density": rho},
            "thin": {"young_modulus": stiff, "density": 1e-9 * rho, "stiffness_damping": 1e-3},
        },
        "initial": {"velocity": [0.3, -0.2, 0.1], "angular_velocity": [1.0, 2.0, 0.5]},
        "gravity": {"acceleration": [0.0, 0.0, -9.81]},
        "support": [{"node_set": "n0", "fix": "xyz"}],
        "output": {"fields_every": 0, "probe": [{"name": "all", "node_set": "all"}]},
        "solver": {"rtol": 1e-12},
        "time": {"integrator": scheme, "step": step, "end": 0.03},
    }
    lengths = [np.linalg.norm(points[a] - points[b]) for a, b in other]
    springs = [{"between": [f"n{a}", f"n{b}"], "stiffness": stiff * area / le} for (a, b), le in zip(other, lengths)]
    dashpots = [{"between": entry["between"], "coefficient": 1e-3 * entry["stiffness"]} for entry in springs]
    sections = {"s": {"area": area, "material": "m"}}
    first = case_of(shared_tmp_path, comm, points, kept, **tables, section=sections, spring=springs, dashpot=dashpots)
    history = run(first, shared_tmp_path / "springs", comm)
    if comm.rank == 0:
        import h5py

        with h5py.File(shared_tmp_path / "bars.h5", "w") as file:
            file["points"], file["bars"] = points, kept + other
            file["bar_groups/thin"] = [5, 6]
    comm.Barrier()
    sections["thin"] = {"area": area, "material": "thin", "bars": "thin"}
    second = Case.from_dict(tables | {"section": sections, "mesh": {"file": "bars.h5"}}, folder=shared_tmp_path)
    expected = run(second, shared_tmp_path / "bars", comm)
    scale = history["external_work"].max()
    assert np.abs(history["probe/all/position"] - expected["probe/all/position"]).max() < 1e-6
    assert history["viscous_dissipation"][-1] == pytest.approx(expected["viscous_dissipation"][-1], rel=1e-5)
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * scale


@pytest.mark.parametrize("scheme", EXPLICIT[:3])
def test_stable_step_counts_them(scheme, comm, shared_tmp_path):
    """A stiff spring, and a stiff dashpot, decide on the step; at 0.99 of it the motion stays bounded."""
    for stiff in (SPRING | {"dashpot": [{"between": ["a", "b"], "coefficient": 400.0}]}, DASHPOT):
        stiff = stiff | {"spring": [{"between": ["a", "b"], "stiffness": 3e6}]}
        case = two_bars(shared_tmp_path, comm, stiff, scheme, step="auto", end=0.05)
        simulation = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True)
        plain = Simulation(two_bars(shared_tmp_path, comm, {}, scheme, "auto", 0.05), comm, check_only=True)
        assert simulation.plan.step < 0.6 * plain.plan.step
        assert simulation.run() == 0
        kinetic = simulation.row["kinetic_energy"] if comm.rank == 0 else 0.0
        assert np.isfinite(kinetic) and kinetic < 1.1 * 2 * 0.5 * MASS * 0.2**2


@pytest.mark.parametrize(
    "tables, told",
    [
        ({"spring": [{"stiffness": [1.0, 1.0, 1.0]}]}, r"spring\[0\].*exactly one of the keys node_set, between"),
        ({"spring": [{"between": ["a", "b"], "stiffness": [1.0, 1.0, 1.0]}]}, r"spring\[0\].stiffness.*one number"),
        ({"spring": [{"node_set": "a", "stiffness": 2.0}]}, r"spring\[0\].stiffness.*three numbers"),
        ({"spring": [{"between": ["a", "c"], "stiffness": 2.0}]}, r"spring\[0\].between.*node set"),
        ({"spring": [{"between": ["a"], "stiffness": 2.0}]}, r"spring\[0\].between"),
        (
            {"dashpot": [{"between": ["a", "a"], "coefficient": 2.0}]},
            r"dashpot\[0\].between: node 1 is the only node of 'a'",
        ),
        ({"dashpot": [{"between": ["a", "b"], "coefficient": 0.0}]}, r"dashpot\[0\].coefficient.*> 0"),
    ],
)
def test_refusals(tables, told, comm, tmp_path):
    with pytest.raises(InputError, match=told):
        case = two_bars(tmp_path, comm, tables, "newmark")
        Simulation(case, comm, check_only=True)


def test_nodes_at_the_same_place_are_refused(comm, tmp_path):
    sets = {"a": {"indices": [1]}, "b": {"indices": [2]}}
    case = case_of(
        tmp_path,
        comm,
        [[0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]],
        [[0, 1], [2, 3]],
        node_set=sets,
        spring=[{"between": ["a", "b"], "stiffness": 1.0}],
    )
    with pytest.raises(InputError, match=r"spring\[0\].between: node 2 of 'b' and node 1 of 'a' have the same pos"):
        Simulation(case, comm, check_only=True)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "energy_momentum"])
def test_beside_heat_wind_yield_and_removals(scheme, comm, tmp_path):
    """All bars of such cases can leave the model and are heated, but not springs and dashpots; energies balance."""
    points = [[0, 0, 0], [1.0, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0.8]]
    bars = [[0, 1], [1, 2], [2, 3], [3, 0], [0, 4], [1, 4], [2, 4]]
    write_mesh(tmp_path / "tent.h5", points, bars, bar_groups={"leg": np.array([4])}, comm=comm)
    strong = {"young_modulus": 1e7, "density": 800.0, "thermal_expansion": 1e-4, "yield_stress": 2e4}
    case = {
        "mesh": {"file": "tent.h5"},
        "node_set": {f"n{k}": {"indices": [k]} for k in range(5)} | {"feet": {"indices": [0, 1, 2]}},
        "material": {"m": {**strong, "isotropic_hardening": 1e5, "rupture": {"stress": 1e9}}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [{"node_set": "feet", "fix": "xyz"}],
        "spring": [{"between": ["n3", "n4"], "stiffness": 3e3}],
        "dashpot": [{"between": ["n3", "n4"], "coefficient": 5.0}, {"node_set": "n3", "coefficient": 0.5}],
        "temperature": [{"table": [[0.0, 0.0], [0.02, 50.0]]}],
        "gravity": {"acceleration": [0.0, 0.0, -9.81]},
        "wind": {"velocity": [10.0, 0.0, 0.0]},
        "remove": [{"bars": "leg", "time": 0.01, "duration": 0.005}],
        "time": {"integrator": scheme, "step": 1e-4, "end": 0.03},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-12},
    }
    history = run(Case.from_dict(case, folder=tmp_path), tmp_path / "out", comm)
    scale = history["kinetic_energy"].max() + history["elastic_energy"].max()
    names = ("rupture_dissipation", "viscous_dissipation", "plastic_dissipation", "thermal_work")
    assert all(np.abs(history[name]).max() > 1e-6 * scale for name in names)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * scale


@pytest.mark.slow
@pytest.mark.parallel
def test_they_are_no_overlapping_bars(comm, shared_tmp_path):
    """A spring with a dashpot beside it, both along a bar and over a node, is what it should be; they join parts."""
    connections = {
        "spring": [{"between": ["root", "far"], "stiffness": K}, {"between": ["root", "a"], "stiffness": K}],
        "dashpot": [{"between": ["root", "far"], "coefficient": C}],
    }
    simulation = Simulation(two_bars(shared_tmp_path, comm, connections, "newmark"), comm, check_only=True)
    entries, told = simulation.inspect()
    assert entries["parts"] == "all bars are connected"
    assert not [text for text in told if "lies on" in text or "lie on" in text]
