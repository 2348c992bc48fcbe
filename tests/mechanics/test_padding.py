"""Padded columns: the same bars, forces and energies as without, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from pfem_petsc.mechanics.kernels import make_kernels
from pfem_petsc.mechanics.materials import elastic, elastoplastic
from pfem_petsc.mechanics.padding import NO_BAR, Padding
from pfem_petsc.mechanics.planes import new_planes
from pfem_petsc.mechanics.strain import engineering
from pfem_petsc.mechanics.sweep import make_sweep
from pfem_petsc.mesh.ordering import bar_order


def truss(cells, kept, seed=1):
    """Return nodes and ordered bars of a cubic lattice with one diagonal, from which bars are missing at random."""
    chance = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(grid)).reshape([n + 1 for n in cells])
    pairs = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:, :, :-1], number[:, :, 1:])]
    pairs.append((number[:-1, :-1], number[1:, 1:]))
    bars = np.concatenate([np.column_stack([a.ravel(), b.ravel()]) for a, b in pairs]).astype(np.int32)
    bars = bars[chance.random(len(bars)) < kept]
    return grid * 0.1 + 1e-3 * chance.random(grid.shape), bars[bar_order(bars, None, len(grid))]


@pytest.mark.parametrize(
    ("cells", "kept"), [((9, 9, 9), 1.0), ((3, 12, 17), 0.97), ((2, 3, 700), 0.9), ((4, 4, 4), 0.5)]
)
@pytest.mark.parametrize(
    ("law", "parameters"),
    [(elastic.LAW, (2e9,)), (elastoplastic.LAW, (2e9, 1e6, 1e8, 0.0, 1.0))],
    ids=["elastic", "elastoplastic"],
)
def test_forces_energies_and_history_are_those_of_the_bars(cells, kept, law, parameters):
    mesh, bars = truss(cells, kept)
    chance = np.random.default_rng(2)
    x = mesh + 1e-4 * chance.standard_normal(mesh.shape)
    rest = np.linalg.norm(mesh[bars[:, 1]] - mesh[bars[:, 0]], axis=1)
    area = 1e-4 * (1.0 + chance.random(len(bars)))
    heat = np.array([1e-4 * chance.random(len(bars)), 300.0 + chance.random(len(bars))])
    sweep = make_sweep(bars, 0, len(bars), len(bars))
    padding = Padding(sweep)
    found = []
    for columns in (None, padding):
        history = np.zeros((len(law.rows), len(bars)))
        arrays = [rest, heat, area, history]
        if columns:
            arrays = [columns.spread(rest, NO_BAR), *(columns.spread(values) for values in arrays[1:])]
        f, energies = np.zeros_like(x), np.zeros(16)
        far = bars.max(axis=1).astype(np.uint32)
        given = (arrays[0], arrays[1], parameters, arrays[2], 1e-6, arrays[3], True, f, energies)
        failed = make_kernels(law, engineering).forces(
            x, *new_planes(len(x)), columns.sweep if columns else sweep, far, *given
        )
        assert failed == (-1, False, 0)
        if columns:
            columns.collect(arrays[3], history)
        found.append((f, energies, history))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.abs(found[0][0]).max() > 0.0
    if len(law.rows):
        assert np.abs(found[0][2]).max() > 0.0


def test_columns_of_a_lattice_are_few_long_runs():
    _, bars = truss((9, 9, 9), 1.0)
    sweep = make_sweep(bars, 0, len(bars), len(bars))
    padding = Padding(sweep)
    assert padding.any and len(padding.sweep.heads) == len(sweep.diagonal) < len(sweep.heads) / 5
    numbers = padding.spread(np.arange(len(bars), dtype=float), NO_BAR)
    assert len(numbers) == padding.sweep.starts[-1] < 1.3 * len(bars)
    columns = np.flatnonzero(numbers >= 0.0)
    np.testing.assert_array_equal(numbers[columns], np.arange(len(bars)))
    assert [padding.bar(int(column)) for column in columns[::37]] == numbers[columns[::37]].astype(int).tolist()
    returned = np.empty(len(bars))
    padding.collect(numbers, returned)
    np.testing.assert_array_equal(returned, np.arange(len(bars)))
    assert padding.counted == len(numbers)


def test_bars_without_order_are_their_own_columns():
    mesh, bars = truss((6, 6, 6), 1.0)
    numbers = np.random.default_rng(5).permutation(len(mesh)).astype(np.int32)
    bars = numbers[bars]
    bars = bars[bar_order(bars, None, len(mesh))]
    padding = Padding(make_sweep(bars, 0, len(bars), len(bars)))
    values = np.arange(len(bars), dtype=float)
    assert not padding.any and padding.spread(values) is values
