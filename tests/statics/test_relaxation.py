"""Equilibria by dynamic relaxation: cables that start straight, nets, tensegrities, floors; ranks and failures."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cables import chain, elastic_catenary, funicular, heavy_cable, run
from helpers.small_models import case_of
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError, SimulationFailure

WIRE = 5.7e10 * 2.2783e-4
WEIGHT = 2844.23 * 2.2783e-4 * 9.81 * 325.0
FOOT_POUNDS = np.array([[0, 0, 0], [20, 0, -5.56], [30, 0, -5], [45, 0, 5.83], [60, 0, 20.0]])


@pytest.mark.parametrize("newton", [True, False])
def test_straight_cable_hangs_as_the_chain_that_it_is(comm, shared_tmp_path, newton):
    row, x = run(heavy_cable(10, newton=newton), comm, shared_tmp_path / "out")
    tension, places = funicular(325.0, 0.0, 32.5, WIRE, np.full(9, WEIGHT / 10))
    assert np.abs(x[:, [0, 2]] - places).max() < (1e-8 if newton else 1e-6)
    assert np.abs(x[:, 1]).max() < 1e-12
    # half the weight of its last bar is the support's own
    reaction = row["probe/ends/reaction"] - [0.0, 0.0, WEIGHT / 20]
    assert np.linalg.norm(reaction, axis=1) == pytest.approx([tension[0], tension[-1]], rel=1e-7)
    assert row["pseudo_steps"] > 100 and (row["newton_iterations"] > 0) == newton
    assert row["kinetic_energy"] == 0.0 and not row["momentum"].any()


@pytest.mark.parallel
@pytest.mark.slow
@pytest.mark.parametrize(("heat", "sag"), [(0.0, 6.352161), (39.26, 8.192650)])
def test_heavy_cable(comm, shared_tmp_path, heat, sag):
    """The elastic catenary, and code_aster's SSNL114: 6.352 m, and 8.195 m once the cable is 39.26 K warmer.

    Its hot value is that of a cable as long as the hot one, with the weight per length of the cold: heavier by the
    thermal strain. Here the mass is that of the unstressed cold cable, which gives 8.1926 m.
    """
    expansion = 2.3e-5 * heat
    assert elastic_catenary(325.0, 325.0, WEIGHT, WIRE, expansion) == pytest.approx(sag, abs=1e-6)
    data = heavy_cable(40) | ({"temperature": [{"value": heat}]} if heat else {})
    _, x = run(data, comm, shared_tmp_path / "out")
    _, places = funicular(325.0, 0.0, 325.0 / 40, WIRE, np.full(39, WEIGHT / 40), expansion)
    assert np.abs(x[:, [0, 2]] - places).max() < 1e-7
    # lumped in 40 bars: the sag is larger by the square of their length
    assert -x[20, 2] == pytest.approx(sag, abs=2.2e-3)
    data["material"]["wire"]["density"] *= 1.0 + expansion
    data["mesh"]["elements"], data["node_set"]["ends"], data["node_set"]["middle"] = (
        80,
        {"indices": [0, 80]},
        {"indices": [40]},
    )
    _, x = run(data, comm, shared_tmp_path / "reference")
    assert -x[40, 2] == pytest.approx(8.195 if heat else 6.352, abs=1e-3)


def test_hanging_cable_with_three_weights(comm, shared_tmp_path):
    """Ansys VM31 in feet and pounds; its E is 20e6 ksi: with psi the cable would stretch by 1.2 % and hang lower."""
    case = chain(
        shared_tmp_path,
        comm,
        FOOT_POUNDS,
        (6e3, 12e3, 4e3),
        material={"m": {"young_modulus": 20e9, "density": 1.0}},
        section={"s": {"area": 0.1, "material": "m"}},
    )
    row, _ = run(case, comm, shared_tmp_path / "out")
    assert row["probe/ends/reaction"][0] == pytest.approx([-18000.0, 0.0, 5000.0], rel=3e-4, abs=1e-6)
    if comm.rank == 0:
        assert open_result(shared_tmp_path / "out").field("axial_force", -1).max() == pytest.approx(24762.0, rel=3e-4)


@pytest.mark.parallel
def test_a_mechanism_swings_down(comm, shared_tmp_path):
    """Two bars that are hinged at one end alone, out along x; it hangs straight down, stretched by its weight."""
    case = chain(shared_tmp_path, comm, [[0, 0, 0], [1, 0, 0], [2, 0, 0]], fixed=[0], gravity=-9.81)
    _, x = run(case, comm, shared_tmp_path / "out")
    below = 0.1 * 9.81 * np.array([1.5, 0.5])  # weight below the middle of each bar
    stretched = np.cumsum(1.0 + below / 1e5)
    assert x[1:] == pytest.approx(np.array([[0, 0, -stretched[0]], [0, 0, -stretched[1]]]), abs=1e-7)


def test_a_free_mode_is_left_alone(comm, shared_tmp_path):
    """A slack chain without weight beside a loaded one: its middle node has no stiffness, and need not have any."""
    points = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]]
    case = chain(shared_tmp_path, comm, points, (100.0,), fixed=(0, 2, 4))
    row, x = run(case, comm, shared_tmp_path / "out")
    tension, places = funicular(2.0, 0.0, 1.0, 1e5, np.array([100.0]))
    assert x[1, [0, 2]] == pytest.approx(places[1], abs=1e-8)
    assert x[3] == pytest.approx([3, 0, 0], abs=1e-8)
    assert np.linalg.norm(row["probe/ends/reaction"][0]) == pytest.approx(tension[0], rel=1e-8)


@pytest.mark.parallel
@pytest.mark.slow
@pytest.mark.parametrize("sides", [3, 4, 5])
def test_tensegrity_prism_turns_to_its_angle(comm, shared_tmp_path, sides):
    """90 degrees and 180/sides from the foot of a strut to its head (Connelly & Back 1998), 150 for three struts."""
    case = Case.load("tensegrity_prism", [f"mesh.sides={sides}", f"mesh.twist={75.0 + 180.0 / sides}"])
    row, x = run(case, comm, shared_tmp_path / "out")
    bottom, top = x[:sides], x[sides:]
    arms = [part[:, :2] - part[:, :2].mean(axis=0) for part in (bottom, top)]
    angles = [np.degrees(np.arctan2(arm[:, 1], arm[:, 0])) for arm in arms]
    assert (angles[1] - angles[0]) % 360.0 == pytest.approx(90.0 + 180.0 / sides, abs=1e-6)
    assert np.ptp(top[:, 2]) < 1e-9
    if comm.rank == 0:
        force = open_result(shared_tmp_path / "out").field("axial_force", -1)
        assert force[: 3 * sides].min() > 10.0 and force[3 * sides :].max() < -10.0
    assert np.abs(row["support_force"]).max() < 1e-6


@pytest.mark.slow
def test_a_shallow_truss_snaps_through(comm, shared_tmp_path):
    """Beyond its limit load the crown goes to where bars pull: the equilibrium of the closed form below."""
    stiffness, rest, push = 1e5, np.hypot(1.0, 0.2), 600.0
    case = chain(
        shared_tmp_path,
        comm,
        [[0, 0, 0], [1, 0, 0.2], [2, 0, 0]],
        (push,),
        support=[{"node_set": "ends", "fix": "xyz"}, {"node_set": "at1", "fix": "y"}],
        static={"method": "relaxation", "step": 0.25},
    )
    _, x = run(case, comm, shared_tmp_path / "out")
    z = x[1, 2]
    length = np.hypot(1.0, z)
    assert z < -0.2
    assert -2.0 * stiffness * (length / rest - 1.0) * z / length == pytest.approx(push, rel=1e-8)
    if comm.rank == 0:
        z = open_result(shared_tmp_path / "out").history["probe/all/position"][:, 1, 2]
        assert z[1] > 0.15 > -0.2 > z[2]  # the limit is at 0.49


def column(folder, comm, bend, **static):
    """Two bars on top of each other, beside their joint one of k = E A/(100 m); 1.2 times the load k l/2 = 5 N."""
    points = [[0.0, 0.0, 0.0], [bend, 0.0, 1.0], [0.0, 0.0, 2.0], [100.0, 0.0, 1.0]]
    return case_of(
        folder,
        comm,
        points,
        [[0, 1], [1, 2], [1, 3]],
        node_set={"feet": {"indices": [0, 3]}, "joint": {"indices": [1]}, "top": {"indices": [2]}},
        material={"m": {"young_modulus": 1e6, "density": 1.0}},
        section={"s": {"area": 1e-3, "material": "m"}},
        support=[
            {"node_set": "feet", "fix": "xyz"},
            {"node_set": "joint", "fix": "y"},
            {"node_set": "top", "fix": "xy"},
        ],
        load=[{"node_set": "top", "force": [0.0, 0.0, -6.0]}],
        static={"method": "relaxation", **static},
    )


@pytest.mark.slow
def test_a_column_that_is_hardly_bent_buckles(comm, shared_tmp_path):
    """It passes the unstable equilibrium, where Newton's method would stay, with a small residual; its top falls
    through, as the load that it bears decreases, and it hangs."""
    results = [
        run(column(shared_tmp_path, comm, 1e-6, newton=newton), comm, shared_tmp_path / str(newton))
        for newton in (True, False)
    ]
    assert results[0][1] == pytest.approx(results[1][1], abs=1e-6)
    assert results[0][1][2] == pytest.approx([0.0, 0.0, -2.012], abs=1e-4)


@pytest.mark.slow
def test_an_unstable_equilibrium_is_told(comm, shared_tmp_path, capsys):
    case = chain(
        shared_tmp_path,
        comm,
        [[0, 0, 0], [0, 0, 1], [0, 0, 2]],
        support=[{"node_set": "at0", "fix": "xyz"}, {"node_set": "at2", "fix": "xy"}],
        load=[{"node_set": "at2", "force": [0.0, 0.0, -10.0]}],
    )
    _, x = run(case, comm, shared_tmp_path / "out")
    assert x[:, 2] == pytest.approx([0.0, 1.0 - 1e-4, 2.0 - 2e-4], abs=1e-9)
    told = comm.bcast(capsys.readouterr().err)
    assert "load factor 1: the equilibrium is unstable, with 2 negative eigenvalues" in told


@pytest.mark.slow
def test_bars_that_yield_remember_equilibria_alone(comm, shared_tmp_path):
    """Two bars pushed and let go: what Newton's method gives, although the pseudo-motion swings beyond."""
    histories = []
    for method in ("newton", "relaxation"):
        static = {"method": method, "step": 0.25} | ({"newton": False} if method == "relaxation" else {})
        case = chain(
            shared_tmp_path,
            comm,
            [[0, 0, 0], [1, 0, -1], [2, 0, 0]],
            material={"m": {"young_modulus": 1e9, "density": 1.0, "yield_stress": 2e6, "isotropic_hardening": 1e8}},
            support=[{"node_set": "ends", "fix": "xyz"}, {"node_set": "at1", "fix": "y"}],
            load=[{"node_set": "at1", "force": [0, 0, -400.0], "table": [[0.0, 0.0], [0.5, 1.0], [1.0, 0.1]]}],
            static=static,
            output={"fields_every": 1, "probe": [{"name": "all", "node_set": "all"}]},
        )
        with Simulation(case, comm, output=shared_tmp_path / method, quiet=True) as simulation:
            simulation.run()
        histories.append(open_result(shared_tmp_path / method).history)
    newton, relaxation = histories
    assert newton["plastic_dissipation"][-1] > 0.1
    for name in ("probe/all/position", "plastic_dissipation", "elastic_energy", "load_factor"):
        np.testing.assert_allclose(relaxation[name], newton[name], rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_chain_that_rests_on_a_floor(comm, shared_tmp_path):
    """A mooring line, anchor and part of it on the floor, beside pycatenary 1.0.0 (scripts/peers/run_pycatenary.py).

    ``MooringLine(L=6.98, w=1.036, EA=5600.0, anchor=[0, 0, 0], fairlead=[5.2, 1, 2.65], floor=True)`` has the
    horizontal and vertical tension at the fairlead and the length on the floor below. The reaction there bears half of
    the last bar's weight, as the end of a cable does.
    """
    horizontal, vertical, lying = 0.7530436, 3.4154658, 3.6832184
    n, top = 60, np.array([5.2, 1.0, 2.65])
    points = np.outer(np.linspace(0.0, 1.0, n + 1), [6.98, 0.0, 0.0])
    case = chain(
        shared_tmp_path,
        comm,
        points,
        material={"m": {"young_modulus": 5600e4, "density": 1.036 / 9.81e-4}},
        support=[
            {"node_set": "at0", "fix": "xyz"},
            {"node_set": f"at{n}", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, *(top - points[-1])]]},
        ],
        gravity=-9.81,
        wall=[{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}],
    )
    row, x = run(case, comm, shared_tmp_path / "out")
    anchor, fairlead = row["probe/ends/reaction"]
    assert np.hypot(*anchor[:2]) == pytest.approx(horizontal, rel=1e-3)
    assert np.hypot(*fairlead[:2]) == pytest.approx(horizontal, rel=1e-3)
    assert fairlead[2] == pytest.approx(vertical, rel=1e-3)
    assert (x[1:, 2] < 1e-9).sum() * 6.98 / n == pytest.approx(lying, abs=6.98 / n)
    assert fairlead[:2] / np.hypot(*fairlead[:2]) == pytest.approx(top[:2] / np.hypot(*top[:2]), abs=1e-6)


INCREMENTS = [
    *("static.step=0.25", "mesh.cells=[4, 4]", "output.checkpoint_every=1", "output.fields_every=1"),
]
FLOOR = "wall=[{name='floor', type='plane', point=[0.0, 0.0, -2.3], normal=[0.0, 0.0, 1.0]}]"


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("newton", [True, False])
def test_ranks_agree(comm, shared_tmp_path, newton):
    keys = [*INCREMENTS, FLOOR, "material.rope.young_modulus=1e7", "static.step=0.5"]
    keys += [f"static.newton={str(newton).lower()}", "static.tolerance=1e-11"]
    row, x = run(Case.load("hanging_net", keys), comm, shared_tmp_path / "all")
    alone = None
    if comm.rank == 0:
        alone = run(Case.load("hanging_net", keys), MPI.COMM_SELF, shared_tmp_path / "one")
    alone, places = comm.bcast(alone)
    assert np.abs(x - places).max() < 1e-8 * 10.0
    for name in ("elastic_energy", "wall/floor/force", "support_force"):
        assert row[name] == pytest.approx(alone[name], rel=1e-7, abs=1e-6)


def test_what_does_not_settle_ends_with_its_residual(comm, shared_tmp_path):
    with pytest.raises(SimulationFailure) as failure:
        run(heavy_cable(10, step=0.5, max_iterations=50), comm, shared_tmp_path / "out")
    assert failure.value.exit_status == 3
    text = str(failure.value)
    for part in ("load factor 0.5", "50 pseudo-steps", "residual", "required", "worst at node", "max_iterations"):
        assert part in text
    assert list(open_result(shared_tmp_path / "out").history["load_factor"]) == [0.0]


@pytest.mark.parallel
def test_crushed_bars_end_the_run_on_all_ranks(comm, shared_tmp_path):
    case = chain(shared_tmp_path, comm, [[0, 0, 0], [1, 0, 0]], support=[
        {"node_set": "at0", "fix": "xyz"}, {"node_set": "at1", "fix": "yz"}],
        load=[{"node_set": "at1", "force": [-1e6, 0, 0]}])  # fmt: skip
    with pytest.raises(SimulationFailure, match="bar 0 collapsed"):
        run(case, comm, shared_tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wall": [{"name": "floor", "type": "plane", "point": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, 1.0],
                    "friction": 0.2}]}, "wall 'floor': friction"),
        ({"contact_pair": [{"name": "pair", "first": "at1", "second": "at2", "direction": [1.0, 0.0, 0.0]}]},
         r"does not support \[\[contact_pair\]\]"),
        ({"static": {"method": "relaxation", "dampng": 1.0}}, "static.dampng"),
        ({"static": {"method": "relaxation", "tolerance": 2.0}}, "static.tolerance"),
    ],
)  # fmt: skip
def test_refusals(comm, shared_tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        run(chain(shared_tmp_path, comm, [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], **change), comm,
            shared_tmp_path / "out")  # fmt: skip
