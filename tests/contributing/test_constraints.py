"""The constraint of CONTRIBUTING.md: tethers and struts."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pages import run
from helpers.stopped import assert_restart_is_bitwise

from pfem_petsc import Case, open_result
from pfem_petsc.errors import InputError

LOOSE = ["mesh.elements=1", "material.default.young_modulus=1e-9", "wall=[]", "output.fields_every=0"]
"""A rod whose bars bear nothing: point masses."""
QUARTER = 1.8540746773013719 / np.sqrt(9.81)
"""Time [s] that a pendulum of 1 m takes from the horizontal to its lowest point: K(1/2) sqrt(l/g)."""


def history_of(folder) -> dict[str, np.ndarray]:
    history = open_result(folder).history
    return {name: np.asarray(history[name]) for name in history}


def tether(first: str, second: str, length: float, bound: str = "at_most") -> str:
    keys = f'name="rope", kind="tether", first="{first}", second="{second}", length={length!r}, bound="{bound}"'
    return f"constraint=[{{{keys}}}]"


def pendulum(integrator: str, steps: int, *keys: str) -> Case:
    """A point mass of 0.5 kg falls on a tether of 1 m, from the horizontal to the lowest point."""
    own = ["node_set.foot.nearest=[0, 0, 0]", 'support=[{node_set="foot", fix="xyz"}]', "initial.velocity=[0, 0, 0]"]
    own += [f"time.integrator={integrator}", f"time.step={QUARTER / steps!r}", f"time.end={QUARTER!r}"]
    own += ["gravity.acceleration=[0, 0, -9.81]", tether("foot", "tip", 1.0), "solver.rtol=1e-12"]
    return Case.load("rod_impact", [*LOOSE, *own, *keys])


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    "integrator, error",
    [("central_differences", 8e-4), ("chung_lee", 2e-2), ("houbolt", 6e-3)],
)
def test_pendulum_on_a_tether(integrator, error, examples, comm, shared_tmp_path):
    """Against elliptic integrals: place, velocity sqrt(2 g l) and tension 3 m g at the lowest point, after
    K(1/2) sqrt(l/g), with errors of second order; its length to rounding."""
    errors = []
    for steps in (50, 100):
        run(pendulum(integrator, steps), comm, shared_tmp_path / str(steps))
        history = history_of(shared_tmp_path / str(steps))
        x, v = history["probe/tip/position"][:, 0], history["probe/tip/velocity"][:, 0]
        force = history["constraint/rope/force"]
        assert np.linalg.norm(x, axis=1) == pytest.approx(np.ones(steps + 1), abs=1e-14)
        assert (history["active_contacts"][1:] == 2).all()
        energy = history["kinetic_energy"] - history["external_work"]
        assert np.abs(history["energy_imbalance"]).max() < 1e-9
        speed = abs(v[-1, 0] / -np.sqrt(2.0 * 9.81) - 1.0)
        errors.append(np.array([abs(x[-1, 0]), speed, np.abs(energy).max() / 4.905, abs(force[-1, 2] / 14.715 - 1.0)]))
    assert errors[1].max() < error
    assert (errors[1] < 0.3 * errors[0] + 1e-6).all()


def two_rods(integrator: str, rope: str, *keys: str) -> Case:
    """Two rods of 1 m fly apart, askew, between their ends 0.1 m of room and a tether."""
    own = ["mesh.length=1.0", "mesh.elements=3", "mesh.gap=0.1", 'node_set.tip={group="first_end"}', "wall=[]", rope]
    own = ["mesh.generator=two_rods", *own, "node_set.other.group=second_start", "node_set.right.indices=[4, 5, 6, 7]"]
    own += ["node_set.left.indices=[0, 1, 2, 3]", f"time.integrator={integrator}", "time.step=0.02", "time.end=1.5"]
    own += ['initial.on=[{node_set="right", velocity=[0.3, 0.1, -0.05]}]', "initial.velocity=[-0.3, 0.0, 0.2]"]
    return Case.load("rod_impact", [*own, "output.fields_every=1", "solver.rtol=1e-12", *keys])


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    "integrator, keys",
    [
        ("central_differences", ()),
        ("central_differences", ("time.mass=consistent",)),
        ("newmark", ("solver.operator=assembled", "solver.linear=cg")),
        ("newmark", ("solver.operator=matrix_free", "solver.linear=cg")),
        ("energy_momentum", ()),
        ("generalized_alpha", ()),
    ],
)
def test_tether_between_bodies(integrator, keys, examples, comm, shared_tmp_path):
    """Momentum stays to rounding, and that of each body changes by the impulse; the distance is never above the length;
    the force is along the line between the nodes and never pushes."""
    run(two_rods(integrator, tether("tip", "other", 0.2), *keys), comm, shared_tmp_path / "run")
    result, history = open_result(shared_tmp_path / "run"), history_of(shared_tmp_path / "run")
    start = history["momentum"][0]
    assert np.abs(history["momentum"] - start).max() < 1e-11 * np.abs(start).max()
    turned = history["angular_momentum"] - history["angular_momentum"][0]
    assert np.abs(turned).max() < (1e-11 if integrator == "central_differences" and not keys else 2e-2)
    force, taut = history["constraint/rope/force"], 0
    # along the line within the step, where these schemes balance forces; it turns until the end of the step
    turn = 0.02 if integrator in ("energy_momentum", "generalized_alpha") else 1e-9
    for index in range(len(result.times)):
        x = result.positions(index)
        arm = x[4] - x[3]
        distance = np.linalg.norm(arm)
        assert distance < 0.2 + 1e-12
        pull = -force[index] @ arm / distance
        assert pull >= 0.0
        if pull > 0.0:
            taut += 1
            assert np.abs(force[index] + pull * arm / distance).max() < turn * pull
    assert taut > 3
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"][0]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_tether_restarts_to_the_last_bit(integrator, examples, comm, shared_tmp_path):
    # MUMPS, which small models take on several ranks, repeats to rounding only
    case = two_rods(integrator, tether("tip", "other", 0.2), "solver.linear=cg")
    run(case, comm, shared_tmp_path / "first")
    pulls = np.flatnonzero(history_of(shared_tmp_path / "first")["constraint/rope/force"].any(axis=1))
    assert_restart_is_bitwise(case, comm, shared_tmp_path, pulls[1])


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_strut_is_a_contact_pair_on_a_line(integrator, examples, comm, shared_tmp_path):
    """Rods that meet end on: a least distance and a pair bound the same number."""
    keys = ['initial.on=[{node_set="right", velocity=[-0.3, 0, 0]}]', "initial.velocity=[0.3, 0, 0]"]
    pair = 'contact_pair=[{name="rope", first="tip", second="other", direction=[1, 0, 0], gap=0.04}]'
    run(two_rods(integrator, tether("tip", "other", 0.04, "at_least"), *keys), comm, shared_tmp_path / "strut")
    run(two_rods(integrator, pair, *keys), comm, shared_tmp_path / "pair")
    strut, pairs = history_of(shared_tmp_path / "strut"), history_of(shared_tmp_path / "pair")
    assert pairs["pair/rope/force"].any()
    for what in ("force", "impulse"):
        expected = pairs[f"pair/rope/{what}"]
        np.testing.assert_allclose(strut[f"constraint/rope/{what}"], expected, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(strut["kinetic_energy"], pairs["kinetic_energy"], rtol=1e-10)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_nodes_in_a_pair_and_on_a_tether(integrator, examples, comm, shared_tmp_path):
    """Both are kept, one after the other, and together they conserve momentum."""
    pair = 'contact_pair=[{name="gap", first="tip", second="other", direction=[1, 0, 0], gap=0.05}]'
    keys = ['initial.on=[{node_set="right", velocity=[-0.3, 0.1, -0.05]}]', "initial.velocity=[0.3, 0.0, 0.2]"]
    run(two_rods(integrator, tether("tip", "other", 0.15), pair, *keys), comm, shared_tmp_path / "run")
    result, history = open_result(shared_tmp_path / "run"), history_of(shared_tmp_path / "run")
    for index in range(len(result.times)):
        x = result.positions(index)
        assert np.linalg.norm(x[4] - x[3]) < 0.15 + 1e-12 and x[4, 0] - x[3, 0] > 0.05 - 1e-12
    assert history["constraint/rope/force"].any() and history["pair/gap/force"].any()
    assert np.abs(history["momentum"] - history["momentum"][0]).max() < 1e-12
    assert np.abs(history["energy_imbalance"]).max() < 1e-9


def chain(integrator: str, *keys: str) -> Case:
    """Five point masses on a chain of tethers that share nodes, hanging along x, or falling from there."""
    own = ["mesh.elements=5", "node_set.foot.nearest=[0, 0, 0]", 'support=[{node_set="foot", fix="xyz"}]']
    own += ["node_set.upper.indices=[0, 1, 2, 3, 4]", "node_set.lower.indices=[1, 2, 3, 4, 5]"]
    own += [f"time.integrator={integrator}", "time.step=5e-3", "time.end=0.25", "initial.velocity=[0, 0, 0]"]
    own += [tether("upper", "lower", 0.2), "solver.rtol=1e-12", "gravity.acceleration=[9.81, 0, 0]"]
    return Case.load("rod_impact", [*LOOSE, *own, "output.fields_every=1", *keys])


@pytest.mark.parallel
@pytest.mark.parametrize("integrator, mass", [("central_differences", "lumped"), ("newmark", "consistent")])
def test_chain_of_tethers_hangs_at_rest(integrator, mass, examples, comm, shared_tmp_path):
    """Each tether bears the weight below it, from the first row of the history on."""
    run(chain(integrator, f"time.mass={mass}"), comm, shared_tmp_path / "run")
    history = history_of(shared_tmp_path / "run")
    weights = 9.81 * np.array([0.2, 0.2, 0.2, 0.2, 0.1])
    pull = -weights[::-1].cumsum().sum()
    assert history["constraint/rope/force"][:, 0] == pytest.approx(np.full(51, pull), rel=1e-9)
    assert history["support_force"][:, 0] == pytest.approx(np.full(51, -9.81), rel=1e-9)
    assert np.abs(history["probe/tip/position"][:, 0, 0] - 1.0).max() < 1e-12
    assert history["kinetic_energy"].max() < 1e-20


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "houbolt"])
def test_chain_of_tethers_falls_on_a_floor(integrator, examples, comm, shared_tmp_path):
    """Rows that share nodes, and a floor that stops the same nodes: all are kept, and momentum is what was given."""
    wall = 'wall=[{name="floor", type="plane", point=[0, 0, -0.3], normal=[0, 0, 1]}]'
    keys = ["gravity.acceleration=[0, 0, -9.81]", wall, "time.end=0.5"]
    run(chain(integrator, *keys), comm, shared_tmp_path / "run")
    result, history = open_result(shared_tmp_path / "run"), history_of(shared_tmp_path / "run")
    for index in range(len(result.times)):
        x = result.positions(index)
        assert np.linalg.norm(np.diff(x, axis=0), axis=1).max() < 0.2 + 1e-12
        assert x[:, 2].min() > -0.3 - 1e-12
    assert history["wall/floor/contacts"].max() >= 3
    given = history["external_impulse"] + history["support_impulse"] + history["wall/floor/impulse"]
    assert np.abs(history["momentum"] - given).max() < 1e-9
    assert np.abs(history["energy_imbalance"]).max() < 1e-8


@pytest.mark.parametrize(
    "keys, message",
    [
        ((tether("tip", "other", 0.05),), r"constraint 'rope': nodes 3, 4 start 0.05 m beyond it"),
        ((tether("tip", "tip", 0.2),), r"constraint 'rope': node 3 is constrained with itself"),
        ((tether("tip", "right", 0.2),), r"constraint 'rope': first has 1 nodes and second 4"),
        ((tether("tip", "nowhere", 0.2),), r"constraint\[0\].second = \"nowhere\" .*: there is no node set"),
        (
            (tether("tip", "other", 0.2).replace("tether", "rope"),),
            r"kind = \"rope\": unknown value, did you mean|known: tether",
        ),
        ((tether("tip", "other", 0.2), "contact.treatment=stick"), r"constraints need contact.treatment = \"scheme\""),
        (
            (tether("tip", "other", 0.2), 'wall=[{type="sphere", point=[0, 0, 9], radius=1.0, side="outside"}]'),
            r"wall 'wall1' stops nodes of pairs or constraints",
        ),
    ],
)
def test_tethers_that_are_refused(keys, message, examples, comm, shared_tmp_path):
    with pytest.raises(InputError, match=message):
        run(two_rods("newmark", *keys), comm, shared_tmp_path / "run")
