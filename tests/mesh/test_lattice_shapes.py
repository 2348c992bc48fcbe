"""Own cells of lattices, grading, perturbation, missing struts and curved maps."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.meshes import OCTET, degrees, generated, lengths

from pfem_petsc.mesh.generators.lattice.block import random_numbers


def as_sets(mesh):
    place = [tuple(point) for point in np.round(mesh.points, 9).tolist()]
    return set(place), {frozenset((place[a], place[b])) for a, b in mesh.bars.tolist()}


def test_own_cell_is_merged_with_its_neighbours():
    """36 struts of which 12 on faces are given twice make the 24 of the octet cell."""
    own = generated(kind="cell", cells=(2, 1, 3), cell=OCTET | {"groups": {"all": list(range(36))}})
    built_in = generated(kind="octet", cells=(2, 1, 3))
    assert len(OCTET["struts"]) == 36
    assert as_sets(own) == as_sets(built_in)
    assert (own.n_nodes, own.n_bars) == (built_in.n_nodes, built_in.n_bars)
    np.testing.assert_array_equal(own.bar_groups["all"], np.arange(own.n_bars))
    assert own.warnings == []


def test_own_cell_with_struts_to_the_next_cells():
    chain = {"points": [[0.5, 0.5, 0.5]], "struts": [[0, 0, 1, 0, 0], [0, 0, 0, 1, 0]], "groups": {"x": [0], "y": [1]}}
    mesh = generated(kind="cell", cells=(3, 4, 1), cell=chain, pitch=1.0)
    assert (mesh.n_nodes, len(mesh.bar_groups["x"]), len(mesh.bar_groups["y"])) == (12, 8, 9)
    np.testing.assert_array_equal(lengths(mesh), 1.0)
    assert "is a mechanism" in mesh.warnings[0]


def test_graded_pitch_follows_its_differential_equation():
    """dx/ds = p (1 + a x) from 0 is x = (exp(a p s) - 1)/a."""
    pitch, a = 0.1, 2.0
    mesh = generated(kind="cubic", cells=(5, 2, 4), pitch=pitch, grading=["1 + 2*x", 3, 1])
    x = np.unique(mesh.points[:, 0])
    np.testing.assert_allclose(x, (np.exp(a * pitch * np.arange(6)) - 1.0) / a, rtol=1e-8)
    np.testing.assert_allclose(np.unique(mesh.points[:, 1]), 0.3 * np.arange(3), rtol=1e-14)
    assert mesh.volume == pytest.approx(x[-1] * 0.6 * 0.4, rel=1e-12)


def test_perturbation_keeps_faces_and_its_bound():
    regular, moved = (
        generated(kind="octet", cells=(4, 4, 4), perturbation=p, seed=s) for p, s in ((None, None), (0.1, 3))
    )
    shift = moved.points - regular.points
    assert 0.019 < np.abs(shift).max() <= 0.02
    for axis, names in enumerate((("left", "right"), ("front", "back"), ("bottom", "top"))):
        for name in names:
            assert not shift[regular.node_groups[name], axis].any()
    free = shift[:, 0][np.abs(regular.points[:, 0] - 0.4) < 0.35]
    assert np.std(free) == pytest.approx(0.02 / np.sqrt(3.0), rel=0.1)
    other = generated(kind="octet", cells=(4, 4, 4), perturbation=0.1, seed=4)
    assert np.abs(other.points - moved.points).max() > 0.02


def test_random_numbers_depend_on_their_number_alone():
    values = random_numbers(7, 2, np.arange(100_000))
    np.testing.assert_array_equal(values[77:5:-3], random_numbers(7, 2, np.arange(77, 5, -3)))
    counts = np.histogram(values, bins=20, range=(0.0, 1.0))[0]
    assert ((counts - 5000.0) ** 2 / 5000.0).sum() < 43.8  # chi-square, 19 degrees of freedom, 1 in 1000
    assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 0.01
    assert abs(np.corrcoef(values, random_numbers(8, 2, np.arange(100_000)))[0, 1]) < 0.01


def test_missing_struts():
    full = generated(kind="octet", cells=(8, 8, 8))
    left = generated(kind="octet", cells=(8, 8, 8), missing=0.1, seed=5, dangling="keep")
    deviation = np.sqrt(0.1 * 0.9 * full.n_bars)
    assert abs(left.n_bars - 0.9 * full.n_bars) < 4.0 * deviation
    assert degrees(left).min() >= 1
    cleaned = generated(kind="octet", cells=(8, 8, 8), missing=0.6, seed=5)
    assert degrees(cleaned).min() >= 2


def test_cylinder_is_closed():
    keys = {"kind": "cubic", "cells": (12, 2, 1), "pitch": 0.1}
    ring = generated(**keys, curved={"shape": "cylinder", "radius": 0.4, "closed": True})
    radius = np.hypot(ring.points[:, 0], ring.points[:, 2])
    np.testing.assert_allclose(radius[ring.node_groups["bottom"]], 0.4, rtol=1e-14)
    np.testing.assert_allclose(radius[ring.node_groups["top"]], 0.5, rtol=1e-14)
    assert ring.n_nodes == 12 * 3 * 2
    assert "left" not in ring.node_groups
    # every rib of nodes around the axis is like the next
    assert len(set(degrees(ring).reshape(12, -1).sum(axis=1).tolist())) == 1
    chord = 2.0 * 0.4 * np.sin(np.pi / 12.0)
    assert np.count_nonzero(np.isclose(lengths(ring), chord)) == 12 * 3
    assert ring.volume == pytest.approx(np.pi * (0.5**2 - 0.4**2) * 0.2)


def test_sphere_is_a_part_of_a_shell():
    cap = generated(
        kind="octet", cells=(6, 4, 1), pitch=0.1, curved={"shape": "sphere", "radius": 1.0}, origin=[0.0, 0.0, -1.0]
    )
    radius = np.linalg.norm(cap.points + [0.0, 0.0, 1.0], axis=1)
    np.testing.assert_allclose(radius[cap.node_groups["bottom"]], 1.0, rtol=1e-14)
    np.testing.assert_allclose(radius[cap.node_groups["top"]], 1.1, rtol=1e-14)
    # the volume of the shell, against thin layers of a fine grid of its own
    a, b = np.meshgrid((np.arange(400) + 0.5) / 400 * 0.6 - 0.3, (np.arange(400) + 0.5) / 400 * 0.4 - 0.2)
    p, q = np.tan(a), np.tan(b)
    solid = ((1 + p**2) * (1 + q**2) / (1 + p**2 + q**2) ** 1.5).mean() * 0.6 * 0.4
    assert cap.volume == pytest.approx(solid * (1.1**3 - 1.0) / 3.0, rel=1e-5)
