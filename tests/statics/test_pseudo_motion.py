"""Masses of the pseudo-motion, beside NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from pfem_petsc.statics.relaxation import node_stiffness


@pytest.mark.parametrize("seed", range(5))
def test_masses_keep_pseudo_steps_stable(seed):
    """Of half the bound on each node's block the highest frequency is at most 2 in a step of 1."""
    random = np.random.default_rng(seed)
    n = 12
    x = random.random((n, 3))
    bars = np.array([[a, b] for a in range(n) for b in range(a + 1, n) if random.random() < 0.4])
    ways = x[bars[:, 1]] - x[bars[:, 0]]
    lengths = np.linalg.norm(ways, axis=1)
    directions = ways / lengths[:, None]
    axial, geometric = 10.0 ** random.uniform(0, 3, len(bars)), random.normal(0.0, 2.0, len(bars))
    modulus = axial * random.choice([0.5, 2.0], len(bars))  # of a bar that yields the present stiffness is less
    stored = np.vstack([directions.T, axial - geometric, geometric])
    counted = random.random(len(bars)) < 0.5
    bound = np.empty(n)
    forces = node_stiffness(x, bars.astype(np.int32), stored, modulus, counted, np.empty((n, 6)), bound)
    assert forces == pytest.approx(((geometric * lengths)[counted] ** 2).sum(), rel=1e-12)

    along = np.maximum(axial, modulus)[:, None, None] * directions[:, :, None] * directions[:, None, :]
    across = np.maximum(geometric, 0.0)[:, None, None] * (np.eye(3) - directions[:, :, None] * directions[:, None, :])
    stiffness, blocks = np.zeros((n, 3, n, 3)), np.zeros((n, 3, 3))
    for (a, b), k in zip(bars, along + across, strict=True):
        for i, j, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
            stiffness[i, :, j] += sign * k
        blocks[a] += k
        blocks[b] += k
    largest = np.linalg.eigvalsh(blocks)[:, -1]
    assert (bound >= largest * (1.0 - 1e-12)).all() and (bound <= 1.75 * largest).all()
    root = np.repeat(1.0 / np.sqrt(0.5 * bound), 3)
    scaled = root[:, None] * stiffness.reshape(3 * n, 3 * n) * root
    assert np.sqrt(np.linalg.eigvalsh(scaled)[-1]) <= 2.0 * (1.0 + 1e-12)
