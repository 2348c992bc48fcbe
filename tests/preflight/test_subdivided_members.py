"""Members divided into several bars, which are mechanisms of a truss, are reported."""

import numpy as np
import pytest
from helpers.counted import TRUSSES
from helpers.mesh_files import case_of

from pfem_petsc import Simulation
from pfem_petsc.preflight.inspection import warnings_before

pytestmark = pytest.mark.parallel


def divided(points, bars, parts):
    """A truss as a mesh generator leaves it: each bar in so many parts."""
    points, divided_bars = [list(point) for point in points], []
    for a, b in bars:
        start, way = np.array(points[a]), np.subtract(points[b], points[a])
        inner = range(len(points), len(points) + parts - 1)
        points += [(start + way * k / parts).tolist() for k in range(1, parts)]
        chain = [a, *inner, b]
        divided_bars += list(zip(chain[:-1], chain[1:]))
    return points, divided_bars


@pytest.mark.slow
@pytest.mark.parallel
def test_subdivided_members_are_told(comm, shared_tmp_path):
    """All inner nodes of the members, also where a member's direction is general; not what a support holds."""
    points, bars, _, _ = TRUSSES["tetrahedron"]
    points = np.array(points) @ np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    for parts in (1, 2, 5):
        mesh = divided(points, bars, parts)
        fixed = [] if parts == 1 else [len(points)]
        simulation = Simulation(case_of(shared_tmp_path, comm, *mesh, fixed), comm, check_only=True)
        told = warnings_before(simulation.case, simulation.model, simulation.plan)
        found = [text for text in told if "Transfinite Curve {:} = 2" in text]
        if parts == 1:
            assert found == []
            continue
        count = len(bars) * (parts - 1) - 1
        assert found[0].startswith(f"{count} nodes are only connected to two collinear bars")
        assert not any("can move freely" in text for text in told)


@pytest.mark.parallel
def test_a_rod_and_a_bent_chain_are_no_subdivided_truss(comm, shared_tmp_path):
    for bend in (0.0, 0.2):
        points = [[0.1 * k, bend * 0.1 * k * k, 0.0] for k in range(8)]
        bars = [[k, k + 1] for k in range(7)]
        simulation = Simulation(case_of(shared_tmp_path, comm, points, bars), comm, check_only=True)
        told = warnings_before(simulation.case, simulation.model, simulation.plan)
        assert not any("collinear" in text for text in told)
