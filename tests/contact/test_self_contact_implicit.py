"""Bars that touch each other in implicit and static steps: derivatives, conservation, equilibria, friction, ranks."""

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.contact.bar_springs import PairLaw
from pfem_petsc.contact.neighbours import segment_distance
from pfem_petsc.contact.self_contact import (
    NORMAL,
    SPRING,
    WIDTH,
    NodeArrays,
    PairArrays,
    add_step_gradients,
    differentiate_pairs,
    evaluate_pairs,
    free_part,
)
from pfem_petsc.errors import InputError, SimulationFailure

YOUNG, RADIUS, REACH = 2e9, 0.01, 0.1
AREA = np.pi * RADIUS**2
SEGMENTS = np.array([[0, 1], [2, 3]])
LAWS = {
    "elastic": PairLaw(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "rough": PairLaw(0.3, 0.0, 1e-2, 0.0, 0.0, 0.0),
    "damped": PairLaw(0.3, 0.02, 1e-2, 0.0, 0.0, 0.0),
    "step": PairLaw(0.0, 0.0, 1e-2, 0.0, 0.0, 0.0),
}


def branches():
    """Ends (4, 3) of bars closer than 0.1 in all ways in which they touch."""
    cross = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.1, -0.5, 0.08], [0.2, 0.5, 0.07]])
    blend = np.array([[-0.5, 0, 0], [0.5, 0, 0], [-0.6, -0.03, 0.08], [0.6, 0.05, 0.07]])
    parallel = np.array([[-0.5, 0, 0], [0.5, 0, 0], [-0.3, 0, 0.08], [0.8, 0, 0.08]])
    end_on_end = np.array([[-1.0, 0, 0], [0, 0, 0], [0.06, 0.03, 0.01], [1.0, 0.4, 0.2]])
    end_on_bar = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.1, 0.02, 0.08], [0.2, 0.3, 0.9]])
    yield from {"cross": cross, "blend": blend, "parallel": parallel, "ends": end_on_end, "end": end_on_bar}.items()
    random = np.random.default_rng(4)
    made = 0
    while made < 30:
        one, centre = random.normal(size=3), random.uniform(-0.3, 0.3, 3)
        other = random.normal(size=3) if made % 2 else one + 0.2 * random.normal(size=3)
        x = np.array([-0.5 * one, 0.5 * one, centre - 0.5 * other, centre + 0.5 * other])
        if 0.01 < segment_distance(x, SEGMENTS, 0, 1)[0] < 0.09:
            made += 1
            yield f"random {made}", x


def one_pair(x, moved):
    numbers = (np.array([number]) for number in (REACH, 0.1, 3.0, True, 3.0, np.inf, 0.0))
    nodes = NodeArrays(np.hstack([x, moved]), 1.0 / np.arange(1.0, 5.0), np.zeros((4, 3)))
    return PairArrays(np.arange(4).reshape(1, 4), *numbers), nodes


def pair_force(x, moved, law, memory, whole):
    """Force (12,) of a pair, and its energy."""
    pairs, nodes = one_pair(x, moved)
    state, sums = np.ones(1, dtype=np.uint8), np.zeros(6)
    if whole:
        add_step_gradients(pairs, state, nodes)
    else:
        evaluate_pairs(pairs, state, memory, memory.copy(), nodes, law, sums)
    return nodes.force.ravel(), sums[0]


@pytest.mark.parametrize("kind", list(LAWS))
def test_derivatives_are_those_of_finite_differences(kind):
    """Also of friction that sticks and slips, of damping, and of discrete gradients."""
    random, law, h, compared = np.random.default_rng(2), LAWS[kind], 1e-6, 0
    for name, x in branches():
        moved, memory = (3e-2 if kind == "damped" else 1e-2) * random.normal(size=(4, 3)), np.zeros((1, WIDTH))
        moved *= 0.02 if kind == "damped" else 1.0
        d, s, t = segment_distance(x, SEGMENTS, 0, 1)
        memory[0, NORMAL : NORMAL + 3] = ((1.0 - t) * x[2] + t * x[3] - (1.0 - s) * x[0] - s * x[1]) / d
        memory[0, SPRING : SPRING + 3] = 1e-3 * random.normal(size=3)
        blocks = np.empty((1, 12, 12))
        pairs, nodes = one_pair(x, moved)
        differentiate_pairs(pairs, np.ones(1, dtype=np.uint8), memory, nodes, law, kind == "step", blocks)
        differences = np.empty((12, 12))
        for column in range(12):
            e = (h * np.eye(12)[column]).reshape(4, 3)
            around = [
                pair_force(x + sign * e, moved + sign * e, law, memory, kind == "step")[0] for sign in (1.0, -1.0)
            ]
            differences[:, column] = (around[0] - around[1]) / (2.0 * h)
        size = np.abs(differences).max()
        if name == "parallel" and kind != "elastic":  # at a kink where two ends are as far along as each other
            continue
        compared += size > 1e-3
        np.testing.assert_allclose(blocks[0], differences, atol=1e-6 * max(size, 1e-3), err_msg=name)
        if kind == "elastic":
            np.testing.assert_allclose(blocks[0], blocks[0].T, atol=1e-13 * size)
    assert compared > 25


def test_the_work_of_a_step_is_the_change_of_the_energy():
    random, memory = np.random.default_rng(5), np.zeros((1, WIDTH))
    for _, x in branches():
        for size in (1e-9, 1e-3, 5e-2):
            moved = size * random.normal(size=(4, 3))
            force = pair_force(x, moved, LAWS["step"], memory, True)[0].reshape(4, 3)
            energies = [pair_force(at, moved, LAWS["elastic"], memory, False)[1] for at in (x - moved, x)]
            assert (force * moved).sum() == pytest.approx(energies[1] - energies[0], abs=1e-15)
            np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-15)
            np.testing.assert_allclose(np.cross(x - 0.5 * moved, force).sum(axis=0), 0.0, atol=1e-15)


def test_iterations_end_before_bars_pass_through_each_other():
    random, limited = np.random.default_rng(7), 0
    for name, x in branches():
        pairs, _ = one_pair(x, x)
        way = random.normal(size=(4, 3))
        part, limiting = free_part(pairs, x, way)
        assert 0.0 < part <= 1.0 and limiting == int(part < 1.0)
        start = segment_distance(x, SEGMENTS, 0, 1)[0]
        distances = [segment_distance(x + p * way, SEGMENTS, 0, 1)[0] for p in np.linspace(0.0, part, 200)]
        assert min(distances) > 0.05 * min(start, REACH), name
        if part < 1.0:  # where it ends, the bars are close
            limited += 1
            assert distances[-1] < 0.2 * min(start, REACH)
            assert free_part(pairs, x, 0.99 * part * way) == (1, 0)  # whatever rounding does at the end
    assert limited > 2
    # along each other they are free, however far
    cross = dict(branches())["cross"]
    assert free_part(
        one_pair(cross, cross)[0], cross, np.array([[0, 0, 0], [0, 0, 0], [0.2, 0, 0], [0.2, 0, 0.0]])
    ) == (1, 0)


def case_of(points, bars, **tables):
    case = {
        "material": {"m": {"young_modulus": YOUNG, "density": 1000.0}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "self_contact": {},
        "output": {"history_every": 1, "fields_every": 0},
    }
    return Case(case | tables, mesh=Truss(np.asarray(points, dtype=float), bars))


def crossed(angle=90.0, lift=0.0201, **tables):
    """Two bars, of which the upper one flies down."""
    c, s = 0.5 * np.cos(np.deg2rad(angle)), 0.5 * np.sin(np.deg2rad(angle))
    moving = {
        "node_set": {"upper": {"indices": [2, 3]}},
        "initial": {"on": [{"node_set": "upper", "velocity": [0.0, 0.0, -2.0]}]},
        "time": {"integrator": "energy_momentum", "step": 2e-5, "end": 1.8e-3},
    }
    points = [[-0.5, 0, 0], [0.5, 0, 0], [-c, -s, lift], [c, s, lift]]
    return case_of(points, [[0, 1], [2, 3]], **moving | tables)


def chains(**tables):
    """Two chains of four bars that fly against each other, askew, and touch at joints and bars."""
    points = [[0.25 * i, 0, 0.02 * (i % 2)] for i in range(5)]
    points += [[0.52 + 0.05 * i, 0.25 * i - 0.5, 0.045 + 0.02 * (i % 2)] for i in range(5)]
    bars = [[i, i + 1] for i in range(4)] + [[i, i + 1] for i in range(5, 9)]
    moving = {
        "node_set": {"one": {"indices": list(range(5))}, "other": {"indices": list(range(5, 10))}},
        "initial": {
            "on": [
                {"node_set": "one", "velocity": [0.3, 0.0, 0.0]},
                {"node_set": "other", "velocity": [-0.4, 0.2, -3.0]},
            ]
        },
        "time": {"integrator": "energy_momentum", "step": 5e-5, "end": 8e-3},
    }
    return case_of(points, bars, **moving | tables)


def rows_of(case, comm, folder, name, **options):
    with Simulation(case, comm, output=folder / name, **options) as simulation:
        rows = [step.row for step in simulation if step.row is not None]
        x = simulation.gather(simulation.state.position)
    return rows, x


def check_restart(whole, again, comm, error=1e-12):
    """Compare positions and the last rows to the bit, on several ranks to rounding: MUMPS adds up in the order in which
    messages arrive. ``error``: that of energies, which is larger where bars overlap by little."""
    (rows, x), (others, y) = whole, again
    assert 0 < len(others) < len(rows)
    error = 0.0 if comm.size == 1 else error
    if comm.rank == 0:
        np.testing.assert_allclose(y, x, rtol=0.0, atol=min(error, 1e-12))
    for key in ("self_contact_energy", "self_contact_dissipation", "elastic_energy"):
        one, other = column(rows, key)[-len(others) :], column(others, key)
        np.testing.assert_allclose(other, one, rtol=error, atol=error * np.abs(one).max())


def column(rows, name):
    return np.array([row[name] for row in rows])


NEWMARK = {"integrator": "newmark", "beta": 0.25, "gamma": 0.5}


@pytest.mark.parallel
@pytest.mark.parametrize("angle", [0.5, 30.0, 90.0])
def test_an_elastic_impact_conserves_energy_and_momentum(angle, comm, shared_tmp_path):
    rows, _ = rows_of(crossed(angle), comm, shared_tmp_path, "run")
    kinetic = column(rows, "kinetic_energy")
    assert 70 < (column(rows, "self_contact/contacts") > 0).sum() < 90
    total = kinetic + column(rows, "elastic_energy") + column(rows, "self_contact_energy")
    np.testing.assert_allclose(total, total[0], rtol=1e-10)
    assert column(rows, "self_contact_energy").max() > 0.2 * kinetic[0]
    for name in ("momentum", "angular_momentum"):
        values = column(rows, name)
        np.testing.assert_allclose(values, np.broadcast_to(values[0], values.shape), atol=1e-10)
    assert np.abs(column(rows, "energy_imbalance")).max() < 1e-10 * kinetic[0]
    assert kinetic[-1] == pytest.approx(kinetic[0], rel=1e-4)  # the rest is in waves of the bars


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [NEWMARK, {"integrator": "generalized_alpha"}, {"integrator": "energy_momentum"}])
def test_implicit_steps_converge_to_explicit_ones(scheme, tmp_path):
    tables = {
        "self_contact": {} if scheme["integrator"] == "energy_momentum" else {"friction": 0.3, "restitution": 0.8}
    }
    explicit = {"integrator": "central_differences", "step": 1e-6, "end": 5e-3}
    rows, x = rows_of(chains(time=explicit, **tables), MPI.COMM_SELF, tmp_path, "explicit")
    others, y = rows_of(chains(time=scheme | {"step": 5e-6, "end": 5e-3}, **tables), MPI.COMM_SELF, tmp_path, "other")
    np.testing.assert_allclose(y, x, atol=1e-3 * 3.0 * 5e-3)
    kinetic = column(rows, "kinetic_energy")
    for name in ("kinetic_energy", "self_contact_dissipation"):
        assert column(others, name)[-1] == pytest.approx(column(rows, name)[-1], abs=2e-3 * kinetic[0])


@pytest.mark.slow
@pytest.mark.parallel
def test_results_do_not_depend_on_the_ranks(comm, shared_tmp_path):
    tables = {"time": NEWMARK | {"step": 5e-5, "end": 8e-3}, "self_contact": {"friction": 0.3, "restitution": 0.8}}
    rows, x = rows_of(chains(**tables), comm, shared_tmp_path, "all")
    one, y = rows_of(chains(**tables), MPI.COMM_SELF, shared_tmp_path, f"one{comm.rank}")
    assert column(rows, "self_contact/contacts").max() >= 2
    for name in ("kinetic_energy", "self_contact_energy", "self_contact_dissipation", "self_contact/contacts"):
        np.testing.assert_allclose(column(rows, name), column(one, name), rtol=1e-6, atol=1e-8)
    if comm.rank == 0:
        np.testing.assert_allclose(x, y, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["rough", "conserving"])
def test_a_restart_continues_to_the_bit(kind, comm, shared_tmp_path):
    tables = {"time": {"integrator": "energy_momentum", "step": 5e-5, "end": 8e-3}}
    if kind == "rough":
        tables = {"time": NEWMARK | {"step": 5e-5, "end": 8e-3}, "self_contact": {"friction": 0.3, "restitution": 0.8}}
    whole = rows_of(chains(**tables), comm, shared_tmp_path, "whole")
    touching = column(whole[0], "self_contact/contacts")
    for step in (int(np.argmax(touching > 0)) + 3, int(np.argmax(touching)) + 1):
        part = tables | {"output": {"checkpoint_every": step, "history_every": 1, "fields_every": 0}}
        ends = part["time"] | {"end": (step + 0.5) * 5e-5}
        rows_of(chains(**part | {"time": ends}), comm, shared_tmp_path, f"part{step}")
        again = rows_of(chains(**part), comm, shared_tmp_path, f"part{step}", restart=True)
        check_restart(whole, again, comm)


HALF, INNER, LOWERED, TENSION = 0.5, 0.1, 0.05, 1e4


def cables(**tables):
    """Two taut cables of three bars, one across the other in the middle; the upper one is moved down at its ends."""
    along = np.array([-HALF, -INNER, INNER, HALF])
    zero = np.zeros(4)
    points = np.vstack([np.column_stack([along, zero, zero]), np.column_stack([zero, along, zero + 2.0 * RADIUS])])
    motion = {"motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -LOWERED]]}
    return case_of(
        points,
        [[0, 1], [1, 2], [2, 3], [4, 5], [5, 6], [6, 7]],
        **{
            "section": {"s": {"area": AREA, "material": "m", "pretension": TENSION}},
            "node_set": {"lower": {"indices": [0, 3]}, "upper": {"indices": [4, 7]}},
            "support": [{"node_set": "lower", "fix": "xyz"}, {"node_set": "upper", "fix": "xyz"} | motion],
            "static": {"method": "newton", "step": 0.25},
            **tables,
        },
    )


def cable_force(sag):
    """Force [N] in the middle that gives a cable a sag [m]: the middle bar stays level and carries the tension of the
    others along it, found by bisection of its elongation."""
    rests = [length / (1.0 + TENSION / (YOUNG * AREA)) for length in (HALF - INNER, 2.0 * INNER)]

    def forces(longer):
        length = np.hypot(HALF - INNER - 0.5 * longer, sag)
        tension = YOUNG * AREA * (length / rests[0] - 1.0)
        middle = YOUNG * AREA * ((2.0 * INNER + longer) / rests[1] - 1.0)
        return tension * (HALF - INNER - 0.5 * longer) / length - middle, 2.0 * tension * sag / length

    low, high = 0.0, 0.01
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if forces(middle)[0] > 0.0 else (low, middle)
    return forces(low)[1]


@pytest.mark.parallel
def test_crossed_cables_press_on_each_other(comm, shared_tmp_path):
    rows, x = rows_of(cables(), comm, shared_tmp_path, "run")
    stiffness = YOUNG * AREA / (2.0 * INNER) * (1.0 + TENSION / (YOUNG * AREA))
    # both sag alike, and overlap by force over stiffness: LOWERED = 2 sag + overlap
    low, high = 0.0, 0.5 * LOWERED
    for _ in range(80):
        sag = 0.5 * (low + high)
        low, high = (sag, high) if 2.0 * sag + cable_force(sag) / stiffness < LOWERED else (low, sag)
    assert rows[-1]["self_contact/contacts"] == 1
    assert rows[-1]["self_contact/force"] == pytest.approx(cable_force(sag), rel=1e-9)
    assert rows[-1]["self_contact/overlap"] == pytest.approx(cable_force(sag) / stiffness, rel=1e-9)
    assert column(rows, "newton_iterations").max() <= 6
    if comm.rank == 0:
        np.testing.assert_allclose(x[[1, 2], 2], -sag, rtol=1e-9)


PULLED = [[-0.3, -0.2, 0], [-0.3, 0.2, 0], [0.3, -0.2, 0], [0.3, 0.2, 0], [-0.5, 0, 0.02], [0.5, 0, 0.02]]


def pulled(way, **tables):
    """A bar across two held ones, on which loads press it with 500 N each; then its end is pulled along it."""
    sets = {"base": [0, 1, 2, 3], "bar": [4, 5], "end": [4]}
    motion = {"motion": [[1.0, 0.0, 0.0, 0.0], [2.0, way, 0.0, 0.0]], "interpolation": "linear"}
    return case_of(
        PULLED,
        [[0, 1], [2, 3], [4, 5]],
        **{
            "node_set": {name: {"indices": indices} for name, indices in sets.items()},
            "support": [
                {"node_set": "base", "fix": "xyz"},
                {"node_set": "bar", "fix": "y"},
                {"node_set": "end", "fix": "x"} | motion,
            ],
            "load": [{"node_set": "bar", "force": [0.0, 0.0, -500.0], "table": [[0.0, 0.0], [1.0, 1.0], [2.0, 1.0]]}],
            "static": {"method": "newton", "step": 0.2, "end": 2.0},
            "self_contact": {"friction": 0.3},
            "output": {"history_every": 1, "fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
            **tables,
        },
    )


@pytest.mark.parallel
def test_a_bar_sticks_and_slides_by_coulombs_law(comm, shared_tmp_path):
    axial = YOUNG * AREA
    stiffness = 2.0 / (1.0 / axial + 0.4 / axial)
    # contacts at a fifth of the length from the ends, springs along the bar: their displacements from those of the ends
    at = np.array([[0.8, 0.2], [0.2, 0.8]])
    spring = axial * np.array([[1.0, -1.0], [-1.0, 1.0]]) + stiffness * at.T @ at
    resists = spring[0, 0] - spring[0, 1] * spring[1, 0] / spring[1, 1]
    rows, _ = rows_of(pulled(1e-4), comm, shared_tmp_path, "stick")
    reaction = np.ravel(rows[-1]["probe/end/reaction"])[0]
    assert reaction == pytest.approx(resists * 1e-4, rel=0.01) and reaction < 0.9 * 300.0
    assert rows[-1]["self_contact_dissipation"] == pytest.approx(0.0, abs=1e-10)
    way = 0.02
    rows, x = rows_of(pulled(way), comm, shared_tmp_path, "slide")
    reaction = np.ravel(rows[-1]["probe/end/reaction"])[0]
    assert reaction == pytest.approx(0.3 * 1000.0, rel=1e-3)
    lost = np.diff(column(rows, "self_contact_dissipation"))[-3:]
    np.testing.assert_allclose(lost, 300.0 * 0.2 * way, rtol=1e-3)
    assert np.abs(column(rows, "energy_imbalance")).max() < 1e-6
    if comm.rank == 0:
        assert x[5, 0] == pytest.approx(0.5 + way, abs=5e-4)  # the bar is compressed
        slope = np.arctan2(x[5, 2] - x[4, 2], x[5, 0] - x[4, 0])  # as the contacts are not symmetric any more
        assert reaction == pytest.approx(1000.0 * np.tan(np.arctan(0.3) + slope), rel=1e-6)


@pytest.mark.parallel
def test_static_restart_continues_to_the_bit(comm, shared_tmp_path):
    whole = rows_of(pulled(0.02), comm, shared_tmp_path, "whole")
    part = {"output": {"checkpoint_every": 7, "history_every": 1, "fields_every": 0}}
    with Simulation(pulled(0.02, **part), comm, output=shared_tmp_path / "part") as simulation:
        for step in simulation:
            if step.step == 8:
                break
    again = rows_of(pulled(0.02, **part), comm, shared_tmp_path, "part", restart=True)
    check_restart(whole, again, comm)


def crushed(contact):
    """A column of two octet cells, irregular, whose bars yield, that a support crushes to three tenths."""
    case = {
        "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 2], "pitch": 1.0, "perturbation": 0.1},
        "material": {"a": {"young_modulus": 1e9, "density": 2700.0, "yield_stress": 2e6, "isotropic_hardening": 2e7}},
        "section": {"s": {"area": np.pi * 0.05**2, "material": "a"}},
        "node_set": {
            "bottom": {"box": [[-9.0, -9.0, -9.0], [9.0, 9.0, 0.2]]},
            "top": {"box": [[-9.0, -9.0, 1.8], [9.0, 9.0, 9.0]]},
        },
        "support": [
            {"node_set": "bottom", "fix": "xyz"},
            {"node_set": "top", "fix": "xyz", "motion": [[0, 0, 0, 0], [1, 0, 0, -1.4]], "interpolation": "linear"},
        ],
        "static": {"method": "newton", "step": 0.02, "stabilise": 1e-2, "min_step": 1e-5},
        "solver": {"guard": False},
        "output": {"history_every": 1, "fields_every": 0},
    }
    return Case(case | ({"self_contact": {"radius": 0.03}} if contact else {}))


def passages(places, bars):
    """Number of times that bars without a common node pass through each other on straight ways between places."""
    i, j = np.array([(a, b) for a in range(len(bars)) for b in range(a) if not set(bars[a]) & set(bars[b])]).T
    found, before = 0, None
    for one, other in zip(places[:-1], places[1:], strict=True):
        for part in np.linspace(0.0, 1.0, 20, endpoint=False):
            x = one + part * (other - one)
            u, v, w = x[bars[i, 1]] - x[bars[i, 0]], x[bars[j, 1]] - x[bars[j, 0]], x[bars[j, 0]] - x[bars[i, 0]]
            normal = np.cross(u, v)
            square = np.maximum((normal**2).sum(axis=1), 1e-300)
            s, t = ((np.cross(w, along) * normal).sum(axis=1) / square for along in (v, u))
            inside, side = (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0), (w * normal).sum(axis=1)
            if before is not None:
                found += int((inside & before[0] & (side * before[1] < 0.0)).sum())
            before = inside, side
    return found


@pytest.mark.slow
@pytest.mark.parametrize("contact", [True, False])
def test_a_crushed_lattice_does_not_pass_through_itself(contact, tmp_path):
    with Simulation(crushed(contact), MPI.COMM_SELF, output=tmp_path) as simulation:
        mesh, places, rows = simulation.model.mesh, [], []
        bars = mesh.node_ids[mesh.bars]
        for step in simulation:
            places.append(simulation.gather(simulation.state.position))
            rows.append(step.row)
    assert rows[-1]["load_factor"] == pytest.approx(1.0)
    count = passages(places, bars)
    if contact:
        assert count == 0
        assert rows[-1]["self_contact/contacts"] > 5 and column(rows, "self_contact/overlap").max() < 0.03
    else:
        assert count > 3


def test_supports_that_force_bars_through_others_end_the_run(tmp_path):
    """Two held bars across each other: nothing can give way."""
    motion = {"motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -0.1]], "interpolation": "linear"}
    case = case_of(
        [[-0.5, 0, 0], [0.5, 0, 0], [0, -0.5, 0.05], [0, 0.5, 0.05]],
        [[0, 1], [2, 3]],
        node_set={"lower": {"indices": [0, 1]}, "upper": {"indices": [2, 3]}},
        support=[{"node_set": "lower", "fix": "xyz"}, {"node_set": "upper", "fix": "xyz"} | motion],
        static={"method": "newton", "step": 0.1},
    )
    with (
        pytest.raises(SimulationFailure, match="supports would move bars 0 and 1 through each other"),
        Simulation(case, MPI.COMM_SELF, output=tmp_path) as simulation,
    ):
        simulation.run()


SPHERE = [{"name": "ball", "type": "sphere", "point": [0.0, 0.0, -3.0], "radius": 1.0}]


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"self_contact": {"friction": 0.1}}, 'does not serve time.integrator = "energy_momentum"'),
        ({"self_contact": {"restitution": 0.5}}, 'does not serve time.integrator = "energy_momentum"'),
        ({"wall": SPHERE}, "does not serve walls 'ball', which bars touch between their nodes, with time.integrator"),
        ({"solver": {"operator": "matrix_free"}, "time": NEWMARK | {"step": 1e-5, "end": 1e-4}}, "needs a matrix"),
        ({"solver": {"linear": "multigrid"}, "time": NEWMARK | {"step": 1e-5, "end": 1e-4}}, "needs a matrix"),
    ],
)
def test_what_does_not_work_is_refused(tables, message, tmp_path):
    with pytest.raises(InputError, match=message):
        Simulation(crossed(**tables), MPI.COMM_SELF, output=tmp_path)


@pytest.mark.parametrize("method", ["arc_length", "relaxation"])
def test_other_static_methods_are_refused(method, tmp_path):
    static = {"method": method, "end": 1.0}
    with pytest.raises(InputError, match=rf'does not serve static.method = "{method}" in implicit or static steps'):
        Simulation(cables(static=static), MPI.COMM_SELF, output=tmp_path)


def test_modes_of_states_with_contact_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"does not serve \[modes\] in implicit or static steps; their stiffness"):
        Simulation(cables(modes={"count": 1}), MPI.COMM_SELF, output=tmp_path)


def turn_by(axis, angle):
    """Matrix of a turn (3, 3)."""
    axis = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) - np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


TURN = turn_by([1.0, 2.0, -0.5], 0.7)


@pytest.mark.parallel
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_bars_between_walls_in_any_direction(friction, comm, shared_tmp_path):
    """A bar falls on another that lies on a wall, whose bounds and the forces of bars are solved for at once."""
    found = []
    for name, turn in (("straight", np.eye(3)), ("oblique", TURN)):
        points = np.array([[-0.5, 0, 0], [0.5, 0, 0], [-0.1, -0.5, 0.0202], [0.2, 0.5, 0.0202]])
        wall = {"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": (turn @ [0.0, 0.0, 1.0]).tolist()}
        case = crossed(
            node_set={"upper": {"indices": [2, 3]}},
            initial={"on": [{"node_set": "upper", "velocity": (turn @ [0.3, 0.0, -2.0]).tolist()}]},
            wall=[wall],
            self_contact={"friction": friction},
            time=NEWMARK | {"step": 1e-4, "end": 2e-3},
        ).to_dict()
        case.pop("mesh")
        case = Case(case, mesh=Truss(points @ turn.T, [[0, 1], [2, 3]]))
        rows, x = rows_of(case, comm, shared_tmp_path, name)
        assert column(rows, "self_contact/contacts").max() == 1 and column(rows, "wall/floor/contacts").max() == 2
        assert column(rows, "newton_iterations").max() <= 8
        found.append((rows, None if x is None else x @ turn))
    (rows, x), (others, y) = found
    if comm.rank == 0:
        np.testing.assert_allclose(y, x, atol=1e-10)
        assert np.abs(x[2:, 2] - 0.0202).max() > 1e-4
    for key in ("kinetic_energy", "self_contact_energy", "self_contact/force"):
        values = column(rows, key)
        np.testing.assert_allclose(column(others, key), values, atol=1e-7 * values.max())


STRAIGHT = np.eye(3)


def on_a_pair(friction, turn=STRAIGHT, **tables):
    """A bar flies onto another, whose nodes meet those of a third one."""
    points = np.array(
        [[-0.5, 0, 0], [0.5, 0, 0], [-0.1, -0.5, 0.0202], [0.2, 0.5, 0.0202], [-0.5, 0, -0.0301], [0.5, 0, -0.0301]]
    )
    pair = {"name": "faces", "first": "lower", "second": "middle", "direction": turn[:, 2].tolist(), "gap": 0.03}
    motion = (
        {}
        if "static" in tables
        else {
            "initial": {"on": [{"node_set": "upper", "velocity": (turn @ [0.3, 0.0, -2.0]).tolist()}]},
            "time": {"integrator": "generalized_alpha", "step": 1e-5, "end": 2e-3},
        }
    )
    sets = {name: {"indices": [2 * i, 2 * i + 1]} for i, name in enumerate(("middle", "upper", "lower"))}
    contact = {"self_contact": {"friction": friction}, "contact_pair": [pair | {"friction": friction}]}
    motion["solver"] = {"rtol": 1e-12}
    return case_of(points @ turn.T, [[0, 1], [2, 3], [4, 5]], **{"node_set": sets, **motion, **contact} | tables)


@pytest.mark.parallel
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_bars_that_touch_beside_pairs(friction, comm, shared_tmp_path):
    """As in explicit steps; the same turned and on one rank; momentum is kept. The matrix in the coordinates of pairs
    gets the entries of bars that begin to touch."""
    explicit = {"integrator": "central_differences", "step": 1e-6, "end": 2e-3}
    _, expected = rows_of(on_a_pair(friction, time=explicit), comm, shared_tmp_path, "explicit")
    rows, x = rows_of(on_a_pair(friction), comm, shared_tmp_path, "straight")
    _, y = rows_of(on_a_pair(friction, TURN), comm, shared_tmp_path, "oblique")
    _, z = rows_of(on_a_pair(friction), MPI.COMM_SELF, shared_tmp_path, f"one{comm.rank}")
    if comm.rank == 0:
        np.testing.assert_allclose(x, expected, atol=1e-5)  # of 4e-3
        np.testing.assert_allclose(y @ TURN, x, atol=1e-10)
        np.testing.assert_allclose(z, x, atol=1e-10)
    assert column(rows, "self_contact/contacts").max() == 1 and column(rows, "newton_iterations").max() <= 4
    assert np.abs(column(rows, "pair/faces/force")).max() > 1000.0
    momentum = column(rows, "momentum")
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(momentum), 1)), atol=1e-13 * np.abs(momentum).max())


@pytest.mark.slow
@pytest.mark.parallel
def test_a_restart_beside_pairs_continues_to_the_bit(comm, shared_tmp_path):
    whole = rows_of(on_a_pair(0.3), comm, shared_tmp_path, "whole")
    step = int(np.argmax(column(whole[0], "self_contact/contacts") > 0)) + 3
    output = {"checkpoint_every": step, "history_every": 1, "fields_every": 0}
    part = {"integrator": "generalized_alpha", "step": 1e-5, "end": (step + 0.5) * 1e-5}
    rows_of(on_a_pair(0.3, output=output, time=part), comm, shared_tmp_path, "part")
    again = rows_of(on_a_pair(0.3, output=output), comm, shared_tmp_path, "part", restart=True)
    check_restart(whole, again, comm, 1e-8)


@pytest.mark.parallel
def test_static_contact_and_pairs_in_series(comm, shared_tmp_path):
    """A bar is lowered onto one that presses on a third by pairs, on springs: their stiffnesses are in series."""
    lowered, spring = 1e-3, 4e5
    down = {"motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -lowered]], "interpolation": "linear"}
    case = on_a_pair(
        0.0,
        static={"method": "newton", "step": 0.25},
        support=[
            {"node_set": "upper", "fix": "xyz"} | down,
            {"node_set": "middle", "fix": "xy"},
            {"node_set": "lower", "fix": "xy"},
        ],
        spring=[
            {"node_set": "lower", "stiffness": [0.0, 0.0, spring]},
            {"node_set": "middle", "stiffness": [0.0, 0.0, 1e-3]},
        ],
    )
    rows, x = rows_of(case, comm, shared_tmp_path, "static")
    if comm.rank == 0:
        np.testing.assert_allclose(x[:2, 2] - x[4:, 2], 0.03, atol=1e-12)
        force = spring * (-0.0301 - x[4:, 2])
        assert rows[-1]["self_contact/force"] == pytest.approx(float(force.sum()), rel=1e-6)
    # gaps of 0.2 and 0.1 mm close; the bars touch at 0.55 of the lower one, which bends the springs unevenly
    soft = (1.0 + np.hypot(1.0, 0.3)) / (2.0 * YOUNG * AREA) + (0.45**2 + 0.55**2) / spring
    assert rows[-1]["self_contact/force"] == pytest.approx((lowered - 0.0003) / soft, rel=1e-3)


def test_a_pair_that_presses_bars_through_others_is_told(tmp_path):
    """Increments are halved up to the force that a contact bears, k R, and the message names the bars."""
    points = [
        [-0.5, 0.01, 0.05],
        [0.5, 0.01, 0.05],
        [-0.5, 0.01, 0.1],
        [0.5, 0.01, 0.1],
        [0.05, -0.5, 0],
        [0.05, 0.5, 0],
    ]
    down = {"motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -0.3]], "interpolation": "linear"}
    case = case_of(
        points,
        [[0, 1], [2, 3], [4, 5]],
        node_set={"middle": {"indices": [0, 1]}, "upper": {"indices": [2, 3]}, "lower": {"indices": [4, 5]}},
        contact_pair=[{"name": "faces", "first": "middle", "second": "upper", "direction": [0, 0, 1.0], "gap": 0.03}],
        spring=[{"node_set": "middle", "stiffness": [100.0, 100.0, 1.0]}],
        support=[{"node_set": "upper", "fix": "xyz"} | down, {"node_set": "lower", "fix": "xyz"}],
        static={"method": "newton", "step": 0.5},
    )
    rows = []
    with (
        pytest.raises(SimulationFailure, match="no equilibrium found .*: bars 0 and 2 would pass through each other"),
        Simulation(case, MPI.COMM_SELF, output=tmp_path) as simulation,
    ):
        for step in simulation:
            rows.append(step.row)
    forces = [row["self_contact/force"] for row in rows if row is not None]
    assert max(forces) == pytest.approx(YOUNG * AREA * 2.0 * RADIUS, rel=0.05)


@pytest.mark.parallel
def test_supports_in_any_direction(comm, shared_tmp_path):
    """Also along none of the axes, whose rows and columns the derivatives do not have."""
    reactions = []
    for name, turn in (("straight", np.eye(3)), ("oblique", TURN)):
        case = pulled(0.004).to_dict()
        points = np.array(PULLED)
        case.pop("mesh")
        frame = [(turn @ axis).tolist() for axis in np.eye(3)[:2]]
        across, end = case["support"][1:]
        case["support"][1:] = [across | {"frame": frame}, end | {"frame": frame}]
        case["load"][0]["force"] = (turn @ [0.0, 0.0, -500.0]).tolist()
        end["motion"] = [[1.0, 0.0, 0.0, 0.0], [2.0, *(turn @ [0.004, 0.0, 0.0])]]
        case["support"][2]["motion"] = end["motion"]
        rows, _ = rows_of(
            Case(case, mesh=Truss(points @ turn.T, [[0, 1], [2, 3], [4, 5]])), comm, shared_tmp_path, name
        )
        reactions.append(np.ravel(rows[-1]["probe/end/reaction"]) @ turn)
        assert column(rows, "newton_iterations").max() <= 6
    np.testing.assert_allclose(reactions[1], reactions[0], rtol=1e-6, atol=1e-6)
