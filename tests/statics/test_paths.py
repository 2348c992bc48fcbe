"""Paths of equilibria beyond limit points and onto branches, against closed forms and published values."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import events, von_mises
from mpi4py import MPI

from pfem_petsc import Case


def heights(history):
    return history["probe/apex/position"][:, 0, 2]


B, H, EA = 1.0, 0.1, 1e9 * 1e-4
L0 = np.hypot(B, H)
# downward load [N] that holds the apex at height z, for each strain measure
LOAD = {
    "engineering": lambda z: 2 * EA * z * (1 / np.sqrt(B**2 + z**2) - 1 / L0),
    "green": lambda z: EA * z * (H**2 - z**2) / L0**3,
    "logarithmic": lambda z: EA * np.log(L0**2 / (B**2 + z**2)) * L0 * z / (B**2 + z**2),
}


def limit_height(strain):
    """Where the load has its maximum, by bisection of its derivative (complex step)."""
    low, high = 1e-3, H
    for _ in range(100):
        middle = 0.5 * (low + high)
        rises = LOAD[strain](middle + 1e-30j).imag > 0.0
        low, high = (middle, high) if rises else (low, middle)
    return middle


@pytest.mark.parametrize("strain", LOAD)
@pytest.mark.parametrize("keys", [{}, {"method": "displacement"}])
def test_whole_path_of_von_mises(strain, keys, tmp_path):
    """All points on the closed form, both limit points to 1e-10 of the load."""
    history = run(von_mises(f"material.default.strain={strain}", **keys), tmp_path / "results", MPI.COMM_SELF)
    z = heights(history)
    load, top = 100.0 * history["load_factor"], limit_height(strain)
    most = LOAD[strain](top)
    np.testing.assert_allclose(load, LOAD[strain](z), atol=1e-7 * most)
    assert z[-1] == pytest.approx(-0.15, abs=1e-12)
    (first, up, way_up), (second, down, way_down) = events(history)
    assert (first, second) == ("limit", "limit")
    assert 100.0 * up == pytest.approx(most, rel=1e-10)
    assert 100.0 * down == pytest.approx(-most, rel=1e-10)
    assert way_up == pytest.approx(H - top, abs=1e-6 * H)
    assert way_down == pytest.approx(H + top, abs=1e-6 * H)
    # the point after each limit point is beyond it
    step = history["event/step"]
    assert (z[step - 1][0] > top > z[step][0]) and (z[step - 1][1] > -top > z[step][1])
    energy = history["elastic_energy"]
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * energy.max()


def test_closed_form_of_the_limit_load():
    """P_max = 2 E A (1 - (b/L0)^(2/3))^(3/2), with engineering strain."""
    exact = 2 * EA * (1 - (B / L0) ** (2 / 3)) ** 1.5
    assert LOAD["engineering"](limit_height("engineering")) == pytest.approx(exact, rel=1e-12)


# ring and apex of the dome of 16 bars on symmetric paths: apex height, ring radius along x (= y), ring height
DOME_EA = 68.9476e9 * 645.16e-6


def dome_force(x):
    """Residuals (3,) of the symmetric dome but for the load: derivatives of its energy, by complex steps."""

    def energy(apex, a, z):
        def bar(square, rest):
            return 0.5 * DOME_EA * rest * (np.sqrt(square) / rest - 1.0) ** 2

        spoke = bar(2 * a * a + (apex - z) ** 2, np.sqrt(2 * 0.127**2 + 0.0508**2))
        side = bar(4 * a * a, 0.254)
        leg = bar((a - 0.254) ** 2 + a * a + z * z, np.sqrt(2 * 0.127**2 + 0.0508**2))
        return 4 * spoke + 4 * side + 8 * leg

    h = 1e-30
    return np.array([energy(*(x + 1j * h * unit)).imag / h for unit in np.eye(3)])


@pytest.fixture(scope="module")
def history(tmp_path_factory):
    """Of the dome of 16 bars."""
    folder = tmp_path_factory.mktemp("dome")
    return run(Case.load("dome_16", ["output.fields_every=0"]), folder / "results", MPI.COMM_SELF)


class TestDomeOf16:
    LIMITS = [0.09566, -0.09612, 0.3209, -0.0938, 0.0938, -0.3209, 0.09612, -0.09566]
    READ_OFF = [(24.1, 0.0966), (75.9, -0.0941), (142.2, 0.3203), (136.3, -0.0901), (66.1, 0.0950), (61.3, -0.3183)]

    @pytest.mark.slow
    def test_limit_points(self, history):
        """The seven of Hrinda 2010 (read off figures) and one more, which the symmetry of the shape asks for."""
        limits = [(1e3 * way, factor) for kind, factor, way in events(history) if kind == "limit"]
        assert [factor for _, factor in limits] == pytest.approx(self.LIMITS, abs=1.1e-4)
        for (way, factor), (read_way, read) in zip(limits, self.READ_OFF, strict=False):
            assert way == pytest.approx(read_way, abs=2.0)
            assert factor == pytest.approx(read, abs=4e-3)
        assert limits[-1] == (pytest.approx(179.9, abs=2.0), pytest.approx(-0.0964, abs=1e-3))

    def test_inverted_dome_has_the_opposite_path(self, history):
        """Turned inside out it is the same dome: critical points at w and 203.2 mm - w have opposite loads."""
        found = sorted((round(1e3 * way, 4), round(factor, 7)) for _, factor, way in events(history))
        mirrored = sorted((round(203.2 - way, 4), -factor) for way, factor in found)
        np.testing.assert_allclose(found, mirrored, atol=2e-4)

    def test_points_against_the_symmetric_dome(self, history):
        """Points of the path balance forces that three unknowns give, computed apart from the package."""
        apex = history["probe/apex/position"][:, 0, 2]
        ring = history["probe/ring/position"][:, 0]
        for z, (a, _, height), factor in zip(apex, ring, history["load_factor"]):
            force = dome_force(np.array([z, a, height]))
            np.testing.assert_allclose(force, [-4.45e6 * factor, 0.0, 0.0], atol=0.05)

    def test_bifurcations(self, history):
        found = [
            (factor, many)
            for kind, factor, many in zip(
                history["event/kind"], history["event/load_factor"], history["event/multiplicity"]
            )
            if kind == "bifurcation"
        ]
        np.testing.assert_allclose(found, [(0.30961, 1), (0.32034, 2), (-0.32034, 2), (-0.30961, 1)], atol=1e-5)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("at", "mode", "limits"),
        [
            (1, 1, [-0.17175, 0.45883, -0.12480]),
            (2, 1, [-0.11696, 0.10494, -0.20895]),
            (2, 3, [-0.09878, 0.09662, -0.14534]),
        ],
    )
    def test_branches(self, at, mode, limits, tmp_path):
        """The path goes on without the symmetry that it had, whichever the direction, and in balance."""
        turned = {}
        for sign in (1, -1):
            case = Case.load(
                "dome_16",
                [f"static.branch_at=[{sign * at}]", f"static.branch_mode={mode}", "static.max_points=85"]
                + ["output.fields_every=0"],
            )
            history = run(case, tmp_path / str(sign), MPI.COMM_SELF)
            kinds, factors = history["event/kind"], history["event/load_factor"]
            first = int(np.flatnonzero(kinds == "bifurcation")[at - 1])
            np.testing.assert_allclose(factors[first + 1 :][kinds[first + 1 :] == "limit"][:3], limits, atol=1e-5)
            z = history["probe/ring/position"][:, :, 2]
            assert np.ptp(z[: history["event/step"][first]], axis=1).max() < 1e-8
            assert np.ptp(z[history["event/step"][first] + 1 :], axis=1).min() > 1e-4
            turned[sign] = z
        np.testing.assert_allclose(np.sort(turned[1]), np.sort(turned[-1]), atol=1e-6)


COARSE = ["static.step=0.05", "output.fields_every=0"]


class TestCoarseSteps:
    """Steps of the dome that are far too large."""

    def test_same_critical_points(self, history, tmp_path):
        """Steps of five times the length, up to a third of the limit load at the start, find the same."""
        coarse = run(Case.load("dome_16", [*COARSE, "static.max_step=10"]), tmp_path / "a", MPI.COMM_SELF)
        assert len(coarse["step"]) < 0.4 * len(history["step"])
        for column in ("kind", "multiplicity"):
            assert coarse[f"event/{column}"].tolist() == history[f"event/{column}"].tolist()
        for column in ("load_factor", "displacement"):
            np.testing.assert_allclose(coarse[f"event/{column}"], history[f"event/{column}"], rtol=1e-8)

    def test_guard(self, tmp_path):
        """A first step of thirty limit loads jumps to the inverted dome; the guard halves it."""
        jump = ["static.step=3", "static.max_step=100", "static.max_points=5", "output.fields_every=0"]
        free = run(Case.load("dome_16", [*jump, "solver.guard=false"]), tmp_path / "free", MPI.COMM_SELF)
        assert free["probe/apex/position"][1, 0, 2] == pytest.approx(0.1016 - 0.22, abs=1e-9)
        guarded = run(Case.load("dome_16", jump), tmp_path / "guarded", MPI.COMM_SELF)
        apex = guarded["probe/apex/position"][:, 0, 2]
        assert np.abs(np.diff(apex)).max() < 0.15
        assert guarded["step_size"][1] <= 0.75
        assert "bifurcation" in guarded["event/kind"]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("branch", ["[]", "[2]"])
def test_same_path_on_any_number_of_ranks(branch, tmp_path):
    comm = MPI.COMM_WORLD
    case = Case.load("dome_16", [f"static.branch_at={branch}", *COARSE, "static.max_points=18"])
    folder = comm.bcast(str(tmp_path))
    together = run(case, f"{folder}/together", comm)
    alone = run(case, tmp_path / f"alone{comm.rank}", MPI.COMM_SELF)
    np.testing.assert_allclose(together["load_factor"], alone["load_factor"], atol=1e-9)
    for column in ("probe/apex/position", "probe/ring/position"):
        np.testing.assert_allclose(together[column], alone[column], atol=1e-8)
    assert together["event/kind"].tolist() == alone["event/kind"].tolist()
    np.testing.assert_allclose(together["event/load_factor"], alone["event/load_factor"], rtol=1e-8)


INCH, PSI, POUND = 0.0254, 6894.757293168, 4.4482216152605


def test_pyramid_of_eight_bars(tmp_path):
    """Hrinda 2010: rise 1.016 m, feet at 12.7 m; 348.4 kN, closed form n E A (1 - (b/L0)^(2/3))^(3/2)."""
    case = von_mises(
        "mesh.legs=8",
        "mesh.rise=1.016",
        "mesh.half_span=12.7",
        "material.default.young_modulus=68.9476e9",
        "section.default.area=6451.6e-6",
        "load[0].force=[0.0, 0.0, -1e6]",
        displacement=2.2,
    )
    history = run(case, tmp_path / "results", MPI.COMM_SELF)
    length = np.hypot(12.7, 1.016)
    exact = 8 * 68.9476e9 * 6451.6e-6 * (1 - (12.7 / length) ** (2 / 3)) ** 1.5
    assert exact == pytest.approx(348.4e3, rel=2e-4)
    limits = [factor * 1e6 for kind, factor, _ in events(history) if kind == "limit"]
    assert limits == pytest.approx([exact, -exact], rel=1e-9)


class TestStarDome:
    @pytest.mark.slow
    def test_limit_points(self, tmp_path):
        """P/(E A) = 3.1565e-4, then -265 N at 30.2 mm."""
        history = run(Case.load("star_dome", ["output.fields_every=0"]), tmp_path / "results", MPI.COMM_SELF)
        (kind, up, way_up), (_, down, way_down) = events(history)
        assert kind == "limit"
        assert 1000.0 * up / (3.03e9 * 3.17e-4) == pytest.approx(3.1565e-4, abs=0.00005e-4)
        assert way_up == pytest.approx(7.68e-3, abs=1e-5)
        assert 1000.0 * down == pytest.approx(-265.0, abs=0.5)
        assert way_down == pytest.approx(30.2e-3, abs=2e-4)

    def test_in_inches(self, tmp_path):
        """Levy and Spillers 2.4.2, E = 30e6 psi, A = 0.0155 in2: 146.8 lbf."""
        case = Case.load(
            "star_dome",
            [
                f"mesh.apex_height={3.2346 * INCH!r}",
                f"mesh.ring_height={2.4472 * INCH!r}",
                f"mesh.ring_radius={9.8425 * INCH!r}",
                f"mesh.base_radius={19.685 * INCH!r}",
                f"material.default.young_modulus={30e6 * PSI!r}",
                f"section.default.area={0.0155 * INCH**2!r}",
                f"load[0].force=[0.0, 0.0, {-220.46 * POUND!r}]",
                "static.step=0.05",
                "static.max_points=30",
                "output.fields_every=0",
            ],
        )
        history = run(case, tmp_path / "results", MPI.COMM_SELF)
        kind, factor, _ = events(history)[0]
        assert (kind, 220.46 * factor) == ("limit", pytest.approx(146.8, abs=0.05))
