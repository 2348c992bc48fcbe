"""Contact between bodies: two rods that collide are the rod against the plane of symmetry."""

import numpy as np
import pytest
from helpers.lattices import (
    DIRECTION,
    TRAPEZOID,
    half,
    planes,
    rotation,
    simulation,
    two_lattices,
    two_rods,
)

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError, SimulationFailure

EXPLICIT = [{"integrator": name} for name in ("central_differences", "chung_lee", "hulbert_chung")]
IMPLICIT = [{"integrator": name} for name in ("newmark", "generalized_alpha", "energy_momentum", "houbolt")]
IMPLICIT += [{"integrator": "wilson", "theta": 1.5}, {"integrator": "central_differences", "mass": "consistent"}]


def label(time):
    return "-".join(str(value) for value in time.values())


def collide(time, comm, shared_tmp_path, linear="auto", treatment="scheme"):
    """Two rods against the symmetric model; the rows of the history. ``auto``: a direct solver, as they are small."""
    cases = two_rods(linear=linear), half()
    for case in cases:
        case["time"] |= time
        case["contact"] = {"treatment": treatment}
    both = simulation(cases[0], comm, shared_tmp_path, "both")
    rows = [step.row for step in both]
    one = simulation(cases[1], comm, shared_tmp_path, "one")
    others = [step.row for step in one]
    force = np.array([row["pair/faces/force"] for row in rows])
    wall = np.array([row["wall/symmetry/force"] for row in others])
    assert np.abs(wall).max() > 0.1
    np.testing.assert_allclose(force, -wall, atol=1e-9)
    x, y = both.gather(both.state.position), one.gather(one.state.position)
    if comm.rank == 0:
        np.testing.assert_allclose(x[:11], y, atol=1e-9)
        np.testing.assert_allclose(2.1 - x[11:][::-1, 0], y[:, 0], atol=1e-9)
    for row in rows:  # momentum of both together, and the ledger
        assert abs(row["momentum"][0]) < 1e-13
        assert abs(row["energy_imbalance"]) < 1e-12
    for name in ("contact_work", "kinetic_energy", "elastic_energy", "numerical_dissipation"):
        np.testing.assert_allclose([row[name] for row in rows], [2.0 * row[name] for row in others], atol=1e-9)
    assert max(row["active_contacts"] for row in rows) == 2
    return rows


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("linear", ["auto", "cg"])  # assembled, and matrix-free
@pytest.mark.parametrize("time", [*EXPLICIT, *IMPLICIT], ids=label)
def test_two_rods_are_the_symmetric_model(time, linear, comm, shared_tmp_path):
    collide(time, comm, shared_tmp_path, linear=linear)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    "solver",
    [{}, {"operator": "matrix_free"}, {"linear": "gamg"}, {"linear": "gamg", "operator": "matrix_free"}],
    ids=str,
)
def test_lattices_turned(solver, comm, shared_tmp_path):
    """Thirteen pairs, oblique to the faces they are on; what solves the steps and in which frame does not matter."""
    turn, found = rotation(5), []
    for k, (frame, keys) in enumerate([(np.eye(3), {}), (turn, solver)]):
        options = {"turn": frame, "step": 1e-3, "end": 0.04, "solver": {"rtol": 1e-12, **keys}}
        run = simulation(
            two_lattices(shared_tmp_path / f"{k}.vtu", "newmark", **options), comm, shared_tmp_path, f"r{k}"
        )
        rows = [step.row for step in run]
        momentum = np.array([row["momentum"] for row in rows])
        np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(rows), 1)), atol=1e-14)
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-11
        assert max(row["active_contacts"] for row in rows) > 20
        found.append((np.array([row["pair/faces/force"] for row in rows]) @ frame, run.gather(run.state.position)))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-9 * np.abs(found[0][0]).max())
    if comm.rank == 0:
        np.testing.assert_allclose(found[1][1] @ turn, found[0][1], atol=1e-10)


@pytest.mark.parametrize("time", [EXPLICIT[0], EXPLICIT[1], *IMPLICIT[:-1], TRAPEZOID], ids=label)
def test_pairs_that_stick(time, comm, shared_tmp_path):
    """No energy is gained, and the two nodes lose that of their motion against each other."""
    rows = collide(time, comm, shared_tmp_path, treatment="stick")
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows])
    assert energy.max() < energy[0] * (1.0 + 1e-6)
    lost = rows[-1]["impact_dissipation"] - rows[-1]["contact_work"]
    assert lost > 0.0
    if time == TRAPEZOID:
        assert lost == pytest.approx(0.05 * energy[0], rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("time", [IMPLICIT[2], TRAPEZOID], ids=label)
def test_pairs_that_do_no_work(time, comm, shared_tmp_path):
    rows = collide(time, comm, shared_tmp_path, treatment="conserving")
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows])
    np.testing.assert_allclose(energy, energy[0], rtol=1e-4)
    assert abs(rows[-1]["contact_work"]) < 1e-12


@pytest.mark.parallel
@pytest.mark.parametrize("treatment", ["stick", "conserving"])
def test_treatments_of_lattices(treatment, comm, shared_tmp_path):
    """Thirteen pairs, one of them with a node that is held: momentum across it, and energy."""
    case = two_lattices(shared_tmp_path / "m.vtu", "energy_momentum", step=1e-3, end=0.04, solver={"rtol": 1e-12})
    case["contact"] = {"treatment": treatment}
    rows = [step.row for step in simulation(case, comm, shared_tmp_path)]
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows])
    momentum = np.array([row["momentum"] for row in rows])
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(rows), 1)), atol=1e-14)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-11
    assert max(row["active_contacts"] for row in rows) > 12
    if treatment == "conserving":
        np.testing.assert_allclose(energy, energy[0], rtol=1e-3)
    assert energy.max() < energy[0] * (1.0 + 1e-6)


def test_unequal_bodies_keep_momentum(comm, shared_tmp_path):
    case = two_rods("central_differences")
    case["section"] = {"s": {"area": 1.0, "material": "m", "bars": "first"}, "t": {"area": 3.0, "material": "m"}}
    rows = [step.row for step in simulation(case, comm, shared_tmp_path)]
    momentum = np.array([row["momentum"][0] for row in rows])
    np.testing.assert_allclose(momentum, 0.1 - 0.3, atol=1e-13)
    assert rows[-1]["pair/faces/force"][0] == 0.0 and max(row["pair/faces/force"][0] for row in rows) > 0.1


@pytest.mark.parallel
@pytest.mark.parametrize(
    "change, message",
    [
        ({"direction": [0.0, 0, 0]}, "zero length"),
        ({"direction": [-1.0, 0, 0]}, "beyond each other"),
        ({"gap": 0.2}, "beyond each other"),
        ({"second": "second"}, "first has 1 nodes and second 11"),
        ({"second": "rigt"}, "no node set of this name"),
        ({"second": "left"}, "contact_pair 'faces': node 10 is paired with itself, .* give node sets without common"),
        (
            {"first": "second", "second": "second"},
            "contact_pair 'faces': two nodes of second .* direction: 11 and 12 to 11; correct direction, or give",
        ),
    ],
)
def test_refusals(change, message, comm, shared_tmp_path):
    with pytest.raises(InputError, match=message):
        simulation(two_rods("central_differences", **change), comm, shared_tmp_path)


@pytest.mark.parallel
@pytest.mark.parametrize("walls", [planes([[1.0, 0, 0]], [-0.5]), []])
def test_ranks_that_own_no_node_of_a_pair(walls, comm, shared_tmp_path):
    """Two rods of four bars on three ranks: the middle ranks have the pair, and others none of its nodes."""
    case = two_rods()
    case["mesh"] |= {"elements": 4, "gap": 0.01}
    case["node_set"]["second"] = {"box": [[1.005, -1, -1], [3, 1, 1]]}
    case["wall"] = walls
    if not walls:  # pairs that share a node
        shared = {"name": "shared", "first": "left", "second": "right", "direction": DIRECTION}
        case["contact_pair"].append(shared)
    case["time"] |= {"end": 1.0}
    rows = [step.row for step in simulation(case, comm, shared_tmp_path)]
    assert max(row["pair/faces/force"][0] for row in rows) > 0.05
    assert max(abs(row["momentum"][0]) for row in rows) < 1e-14
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14


@pytest.mark.parallel
@pytest.mark.parametrize("end, told", [(0.2, 1), (0.8, 0)])
def test_pairs_that_never_press_are_told_at_the_end(comm, shared_tmp_path, end, told):
    """The gap of 0.1 closes at t = 0.5."""
    data = two_rods()
    data["time"]["end"] = end
    run = Simulation(Case.from_dict(data), comm, output=shared_tmp_path / "rods", quiet=True)
    assert run.summary()["contact pairs"] == "faces"
    assert run.run() == 0
    if comm.rank == 0:
        log = (shared_tmp_path / "rods" / "log.txt").read_text()
        assert log.count("contact pair 'faces' never carried a force") == told


@pytest.mark.parallel
@pytest.mark.parametrize("time", [{"integrator": "central_differences"}, {"integrator": "generalized_alpha"}, None])
def test_supports_that_carry_nodes_through_pairs_are_told(time, comm, shared_tmp_path):
    """Nothing can stop nodes of which supports prescribe every component."""
    case = {
        "mesh": {
            "generator": "arrays",
            "points": [[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1]],
            "bars": [[0, 1], [2, 3]],
        },
        "node_set": {"a": {"indices": [0, 1]}, "b": {"indices": [2, 3]}},
        "material": {"m": {"young_modulus": 1e7, "density": 1000.0}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "support": [
            {"node_set": "a", "fix": "xyz"},
            {"node_set": "b", "fix": "xyz", "motion": [[0, 0, 0, 0], [0.1, 0, 0, -2.0]]},
        ],
        "contact_pair": [{"name": "p", "first": "a", "second": "b", "direction": [0, 0, 1]}],
        "output": {"fields_every": 10},
    }
    case |= {"static": {"step": 0.02, "end": 0.1}} if time is None else {"time": time | {"step": 1e-3, "end": 0.1}}
    with pytest.raises(SimulationFailure, match="nodes 0, 2 of 'pair p' are .* m beyond each other, moved there by"):
        simulation(case, comm, shared_tmp_path, label(time or {"static": 0})).run()
