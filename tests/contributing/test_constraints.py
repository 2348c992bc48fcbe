"""The constraint of the folder examples: tethers and struts."""

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
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_tether_restarts_to_the_last_bit(integrator, examples, comm, shared_tmp_path):
    # MUMPS, which small models take on several ranks, repeats to rounding only
    case = two_rods(integrator, tether("tip", "other", 0.2), "solver.linear=cg")
    run(case, comm, shared_tmp_path / "first")
    pulls = np.flatnonzero(history_of(shared_tmp_path / "first")["constraint/rope/force"].any(axis=1))
    assert_restart_is_bitwise(case, comm, shared_tmp_path, pulls[1])


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
            r"constraint 'rope' is on nodes that rub, or that a wall stops which is curved",
        ),
    ],
)
def test_tethers_that_are_refused(keys, message, examples, comm, shared_tmp_path):
    with pytest.raises(InputError, match=message):
        run(two_rods("newmark", *keys), comm, shared_tmp_path / "run")
