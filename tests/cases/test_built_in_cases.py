"""Every built-in case runs and reproduces the numbers in its comments and in docs/gallery.md."""

import gallery
import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.output.result import open_result

pytestmark = pytest.mark.parallel

NUMBERS = {}


def number(function):
    """The function checks the case it is named after."""
    NUMBERS[function.__name__] = function
    return function


@pytest.fixture
def run(comm, shared_tmp_path):
    """Run a built-in case; gives its history as arrays, the same on all ranks."""

    def run(name, *overrides):
        simulation = Simulation(Case.load(name, overrides), comm, output=shared_tmp_path / name, quiet=True)
        assert simulation.run() == 0
        history = None
        if comm.rank == 0:
            result = open_result(shared_tmp_path / name)
            history = {column: result.history[column] for column in result.history}
            if simulation.case.modes is not None:
                history["frequency"] = result.modes.frequency
        return comm.bcast(history)

    return run


def contacts(history, wall):
    """First and last time [s] of each contact with a wall."""
    touching = np.concatenate([[0], history[f"wall/{wall}/contacts"] > 0, [0]]).astype(int)
    first, last = np.flatnonzero(np.diff(touching) == 1), np.flatnonzero(np.diff(touching) == -1) - 1
    return list(zip(history["time"][first], history["time"][last], strict=True))


def forces(history, wall):
    """Wall force of each row [N]."""
    return np.linalg.norm(history[f"wall/{wall}/force"], axis=1)


@number
def dome_earthquake(run):
    """The weight on the supports, the sag of the apex, and how far the shaking moves it relative to the feet."""
    history = run("dome_earthquake")
    begun = np.flatnonzero(history["stage"] == 0)[-1]
    assert history["support_force"][begun, 2] == pytest.approx(268119.188, rel=1e-8)
    way = history["probe/apex/position"][:, 0, 2] - history["probe/feet/position"][:, 0, 2]
    assert way[begun] - way[0] == pytest.approx(-33.551e-3, abs=1e-6)
    assert abs(way[begun:] - way[begun]).max() == pytest.approx(4.7e-3, abs=0.1e-3)
    assert abs(history["energy_imbalance"]).max() < 1e-7 * history["elastic_energy"].max()
    return history["support_force"][begun, 2]


@number
def rod_impact(run):
    """Contact from 0.1 to about 2.1; force spike 2.5 times rho c A v; 2.5 % of the energy lost (formulas: 5.1)."""
    history = run("rod_impact")
    ((first, last),) = contacts(history, "wall")
    assert first == pytest.approx(0.1, abs=0.011)
    assert last == pytest.approx(2.13, abs=0.021)
    assert forces(history, "wall").max() == pytest.approx(2.5 * 0.5, rel=1e-6)
    energy = history["kinetic_energy"] + history["elastic_energy"]
    assert energy[-1] / energy[0] == pytest.approx(0.975, abs=1e-3)
    assert history["momentum"][-1, 0] / history["momentum"][0, 0] == pytest.approx(-0.958, abs=1e-3)
    return energy[-1] / energy[0]


@number
def bar_collision(run):
    """Contact from 5.0 to 105.5 us, mean force 132.7 kN, mean rebound 4.92 m/s (formulas: 5.2)."""
    history = run("bar_collision")
    ((first, last),) = contacts(history, "symmetry")
    assert first == pytest.approx(4.95e-6, abs=5.1e-7)
    assert last == pytest.approx(105.25e-6, abs=5.1e-7)
    force = forces(history, "symmetry")
    assert force.max() == pytest.approx(297e3, rel=1e-3)
    inside = (history["time"] > 5.1e-6) & (history["time"] < 98.9e-6)
    assert force[inside].mean() == pytest.approx(133.5e3, rel=0.02)
    assert 5.136 * history["momentum"][-1, 0] / history["momentum"][0, 0] == pytest.approx(-4.92, abs=0.01)
    return force[inside].mean()


@number
def bar_collision_plastic(run):
    """A plateau of 60.48 kN by plane wave theory, and a longer contact, to 173 us (formulas: 3.2, 5.2)."""
    history = run("bar_collision_plastic")
    ((_, last),) = contacts(history, "symmetry")
    assert last == pytest.approx(173e-6, abs=1e-6)
    plateau = (history["time"] > 20e-6) & (history["time"] < 90e-6)
    assert forces(history, "symmetry")[plateau].mean() == pytest.approx(60.48e3, rel=0.02)
    assert history["plastic_dissipation"][-1] > 0.5 * history["kinetic_energy"][0]
    return forces(history, "symmetry")[plateau].mean()


@number
def ring_impact(run):
    """First contact from 5.0 to 35.0 ms (formulas: 5.3, candidate R1)."""
    history = run("ring_impact", "time.end=0.04")
    ((first, last),) = contacts(history, "wall")
    assert first == pytest.approx(5.0e-3, abs=1e-4)
    assert last == pytest.approx(35.0e-3, abs=1e-4)
    return last


@number
def lattice_drop(run):
    """A smaller one: leaves at 136 us with 4.11 m/s, by an independent computation with half the step."""
    history = run("lattice_drop", "mesh.cells=[8, 8, 8]", "node_set.top.nearest=[0.08, 0.08, 0.08]", "time.end=2e-4")
    episodes = contacts(history, "floor")
    assert episodes[0][0] == pytest.approx(5e-6, abs=3e-6)
    assert episodes[-1][1] == pytest.approx(136e-6, rel=0.03)
    assert 20.0 * history["momentum"][-1, 2] / abs(history["momentum"][0, 2]) == pytest.approx(4.11, rel=0.02)
    return 20.0 * history["momentum"][-1, 2] / abs(history["momentum"][0, 2])


@number
def tumbling_lattice(run):
    """Momentum and angular momentum to rounding, energy within its oscillation."""
    history = run("tumbling_lattice", "time.end=0.05")
    for name in ("momentum", "angular_momentum"):
        assert np.abs(history[name] - history[name][0]).max() < 1e-12 * np.abs(history[name][0]).max()
    energy = history["kinetic_energy"] + history["elastic_energy"]
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-5
    assert history["elastic_energy"].max() > 0.01 * energy[0]
    spin = history["angular_momentum"]
    return np.abs(spin - spin[0]).max() / np.abs(spin[0]).max()


@number
def pendulum(run):
    """Half a period of 1.184 s between two passages of the bottom, bar force there 3 m g (formulas: 3.5)."""
    history = run("pendulum", "time.end=1.8")
    x, time = history["probe/tip/position"][:, 0, 0], history["time"]
    passed = np.flatnonzero(np.sign(x[1:]) != np.sign(x[:-1]))
    bottom = time[passed] - x[passed] * (time[passed + 1] - time[passed]) / (x[passed + 1] - x[passed])
    assert bottom[1] - bottom[0] == pytest.approx(2.36784 / 2, rel=2e-4)
    tension = history["probe/hinge/reaction"][passed[0], 0]
    weight = 0.05 * 9.81  # of the tip; the hinge carries its own half of the bar as well
    assert np.linalg.norm(tension) == pytest.approx(4 * weight, rel=0.01)
    return 2.0 * (bottom[1] - bottom[0])


@number
def taut_cable(run):
    """One row of the initial state, whose only force is the tension; the frequencies: tests/modes/test_vibration.py."""
    history = run("taut_cable")
    assert history["step"].tolist() == [0]
    tension = 2.06842719e11 * 1.979325e-6 * 543.228e-5
    assert tension == pytest.approx(500 * 4.4482216, rel=1e-4)
    rest = 2.54 / (1.0 + 543.228e-5)
    assert history["elastic_energy"] == pytest.approx(0.5 * tension * 543.228e-5 * rest, rel=1e-6)
    return history["frequency"][0]


@number
def octet_buckling(run):
    """Its first peak is less than that of elastoplastic bars by Euler's stress over the yield stress."""
    history = run("octet_buckling")
    force = -history["probe/top/reaction"][:, :, 2].sum(axis=1)
    slenderness = 0.01 / np.sqrt(2.0) / (0.5 * np.sqrt(5e-8 / np.pi))
    assert force.max() == pytest.approx(23.29, abs=0.01)
    assert force.max() / 83.87 == pytest.approx(np.pi**2 * 70e9 / slenderness**2 / 200e6, rel=0.02)
    assert force.min() < -20.0 and abs(force[-1]) > 1.0  # straightened in tension, by the time of its first height
    assert abs(history["energy_imbalance"]).max() < 1e-7 * history["plastic_dissipation"][-1]
    return force.max()


@number
def octet_compression(run):
    """It yields at rho sigma_Y/3 of the relative density (formulas: 7), and the plate leaves it on its way back."""
    history = run("octet_compression")
    density = 6.0 * np.sqrt(2.0) * 1e-6 / (0.01**2 / 2.0)
    force, factor = forces(history, "plate"), history["load_factor"]
    slope = np.diff(force) / np.diff(factor)
    first = force[np.argmax(slope < 0.5 * slope[0])]
    assert first == pytest.approx(density * 200e6 / 3.0 * 0.03**2, rel=0.02)
    assert force[-1] == 0.0
    assert abs(history["energy_imbalance"]).max() < 1e-10 * history["plastic_dissipation"][-1]
    return first


@number
def bracket_drop(run):
    """A third of the energy is dissipated; it leaves the floor with 11.43 m/s."""
    history = run("bracket_drop")
    energy = history["kinetic_energy"][0]
    mass = 38684 * 4e-3 * np.sqrt(0.5) * 5e-8 * 4500.0  # struts inside, of equal length
    assert energy == pytest.approx(0.5 * mass * 25.0**2, rel=1e-9)
    assert contacts(history, "floor")[-1][1] == pytest.approx(113.0e-6, abs=0.8e-6)
    assert history["momentum"][-1, 2] / mass == pytest.approx(11.43, abs=0.01)
    assert history["plastic_dissipation"][-1] / energy == pytest.approx(0.3207, abs=1e-3)
    assert abs(history["energy_imbalance"]).max() < 1e-12 * energy
    return history["plastic_dissipation"][-1] / energy


@number
def hanging_net(run):
    """Corners carry a quarter of the weight each."""
    history = run("hanging_net")
    weight = 1000.0 * 1e-4 * 9.81 * 2 * 11 * 10.0
    assert history["probe/corners/reaction"][-1, :, 2] == pytest.approx(weight / 4.0, rel=1e-7)
    assert history["probe/centre/position"][-1, 0, 2] == pytest.approx(-2.6431, abs=1e-4)
    return history["probe/corners/reaction"][-1, 0, 2]


@number
def net_cut(run):
    """A corner lets go of its quarter of the weight; ropes tear later, with the energy that the limit says, or more."""
    history = run("net_cut", "stage.1.time.end=1.0")
    weight = 1000.0 * 1e-4 * 9.81 * 2 * 11 * 10.0
    held = history["probe/corner/reaction"][:, 0, 2]
    assert held[history["stage"] == 0][-1] == pytest.approx(weight / 4.0, rel=1e-6)
    assert (held[history["time"] > 1.102] == 0.0).all()
    assert history["broken_bars"][-1] == 1
    released = 0.5 * 2.5e6**2 / 1e8 * 1e-4
    assert released < history["rupture_dissipation"][-1] < 1.1 * released
    assert abs(history["energy_imbalance"]).max() < 1e-9 * history["external_work"].max()
    return history["rupture_dissipation"][-1]


@number
def tensegrity_prism(run):
    """The head of a strut is 150 degrees beyond its foot."""
    history = run("tensegrity_prism")
    feet, heads = (history[f"probe/{name}/position"][-1, :, :2] for name in ("bottom", "top"))
    feet, heads = feet - feet.mean(axis=0), heads - heads.mean(axis=0)
    angles = [np.degrees(np.arctan2(arms[:, 1], arms[:, 0])) for arms in (feet, heads)]
    assert (angles[1] - angles[0]) % 360.0 == pytest.approx(150.0, abs=1e-6)
    assert history["elastic_energy"][-1] == pytest.approx(6.1437, rel=1e-4)
    return (angles[1] - angles[0])[0] % 360.0


def limits(history):
    return [factor for kind, factor in zip(history["event/kind"], history["event/load_factor"]) if kind == "limit"]


@number
def von_mises(run):
    """Limit points at +-2 E A (1 - (b/L0)^(2/3))^(3/2) (formulas: 3.3)."""
    exact = 2e5 * (1.0 - 1.01 ** (-1 / 3)) ** 1.5
    found = 100.0 * np.array(limits(run("von_mises")))
    assert found == pytest.approx([exact, -exact], rel=1e-9)
    return found[0]


@number
def star_dome(run):
    """Limit points at P/(E A) = 3.1565e-4 and at -265 N (formulas: 4)."""
    up, down = limits(run("star_dome"))
    assert 1000.0 * up / (3.03e9 * 3.17e-4) == pytest.approx(3.1565e-4, abs=5e-9)
    assert 1000.0 * down == pytest.approx(-265.0, abs=0.5)
    return 1000.0 * up / (3.03e9 * 3.17e-4)


@number
def dome_16(run):
    """Limit points of the path up to the second bifurcation."""
    found = limits(run("dome_16", "static.step=0.05", "static.max_points=15"))
    assert found == pytest.approx([0.09566, -0.09612, 0.3209], abs=1.1e-4)
    return found[2]


@number
def guyed_mast(run):
    """The top leans by 19 mm, guys pull with 10 to 20 kN, and supports bear weight and wind."""
    history = run("guyed_mast")
    steel = 40 * (3 * 1.2 * 1.2e-3 + 3 * np.hypot(1.2, 1.2) * 3e-4) + 41 * 3 * 1.2 * 3e-4
    reach = 30.0 - 1.2 / np.sqrt(3.0)
    ropes = 3 * 1.5e-4 * (np.hypot(reach, 24.0) + np.hypot(reach, 48.0))
    weight = 7850.0 * (steel + ropes) * 9.81 + 123 * 20.0
    assert history["support_force"][-1] == pytest.approx([-123 * 120.0, 0.0, weight], rel=1e-7, abs=1e-3)
    top = history["probe/top/position"]
    assert top[-1, :, 0].mean() - top[0, :, 0].mean() == pytest.approx(0.0194, abs=1e-4)
    pulls = np.linalg.norm(history["probe/anchors/reaction"][-1], axis=1)
    assert pulls == pytest.approx([2.19e4, 3.69e4, 3.69e4], rel=0.01)
    return history["support_force"][-1, 2]


@number
def lattice_crush(run):
    """A plateau as of first yield, contact that carries on from there, and bars that do not overlap."""
    history = run("lattice_crush")
    strain = -5.0 * (history["time"] - 1e-4) / 0.04  # the plate moves from 0.25 mm above nodes moved by up to 0.25 mm
    impulse = history["wall/plate/impulse"][:, 2]
    stress = np.diff(impulse) / np.diff(history["time"]) / -1.6e-3
    plateau = stress[(strain[1:] < -0.2) & (strain[1:] > -0.4)].mean()
    assert stress[strain[1:] < -0.6].mean() > 1.25 * plateau
    assert history["self_contact/overlap"].max() < 0.05 * np.sqrt(1.4731e-6 / np.pi)
    assert history["self_contact/contacts"].max() > 200
    work = history["contact_work"][-1]
    assert history["kinetic_energy"][len(strain) // 10 :].max() < 0.03 * work
    assert abs(history["energy_imbalance"]).max() < 1e-12 * work
    return plateau


@number
def net_catch(run):
    """Momentum of net and ball beside all impulses; ropes yield, and the ball is slower."""
    history = run("net_catch", "time.end=0.3")
    ball = 50.0 * history["wall/ball/velocity"]
    weight = np.outer(history["time"], [0.0, 0.0, -50.0 * 9.81])
    given = history["wall/ball/impulse"] + history["wall/ball/jump_impulse"]
    own = ball - ball[0] - weight + given
    net = history["momentum"] - given
    net = net - sum(history[f"{name}_impulse"] for name in ("external", "support", "damping"))
    size = np.abs(given).max()
    assert size > 10.0
    assert np.abs(net).max() < 1e-12 * size
    assert abs(history["energy_imbalance"]).max() < 1e-9 * history["external_work"].max()
    return np.abs(own + net).max() / size


@number
def truss_collision(run):
    """Momentum to rounding; friction dissipates and takes little of the angular momentum, else nothing does."""
    history = run("truss_collision", "time.end=8e-3")
    energy = history["kinetic_energy"][0]
    assert history["self_contact_dissipation"][-1] > 0.05 * energy
    assert np.diff(history["self_contact_dissipation"]).min() > -1e-12 * energy
    smooth = run("truss_collision", "self_contact.friction=0", "time.end=8e-3")
    for each in (history, smooth):
        assert each["self_contact/contacts"].max() > 20 and each["self_contact/contacts"][-1] == 0
        assert abs(each["energy_imbalance"]).max() < 1e-12 * energy
        assert np.abs(each["momentum"] - each["momentum"][0]).max() < 1e-12 * np.abs(each["momentum"][0]).max()
    assert np.abs(smooth["self_contact_dissipation"]).max() < 1e-12 * energy
    spins = [each["angular_momentum"] for each in (history, smooth)]
    changes = [np.abs(spin - spin[0]).max() / np.abs(spin[0]).max() for spin in spins]
    assert changes[0] < 0.01
    return changes[1]


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize("name", built_in_cases())
def test_promised_numbers(name, run):
    """Those of its comments, and the one of docs/gallery.md, which each function returns."""
    shown = gallery.entries()[name]
    assert NUMBERS[name](run) == pytest.approx(shown["value"], rel=0.0, abs=shown["tolerance"])
