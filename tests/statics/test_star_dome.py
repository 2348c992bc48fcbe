"""Paths of shallow domes with published limit points."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import events, von_mises
from mpi4py import MPI

from pfem_petsc import Case

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
