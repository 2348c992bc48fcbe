"""Where the branch of an opening hinge of a strut has no stable equilibrium at a given strain."""

from __future__ import annotations

import numpy as np

__all__ = ["folds"]

_POINTS = 200  # at which the slope of a branch is looked at
_AT_ONCE = 4096  # bars


def folds(
    ratio: np.ndarray, bending: np.ndarray, shortening: np.ndarray, inverse_yield: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest and smallest angle z (b,) between which the strain decreases with z; both zero without.

    Parameters
    ----------
    ratio, bending, shortening : (b,) r, b and u of :mod:`~pfem_petsc.mechanics.materials.strut`
    inverse_yield : Young's modulus over yield stress
    """
    # digits that differ by rounding must not make other bars of equal ones, or lattices would take long
    numbers = np.stack([ratio, bending, shortening])
    scale = 10.0 ** np.floor(np.log10(np.maximum(numbers, 1e-300)))
    kinds, which = np.unique(np.round(numbers / scale, 9) * scale, axis=1, return_inverse=True)
    found = np.zeros((2, kinds.shape[1]))
    for begin in range(0, kinds.shape[1], _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        found[:, part] = _find(*kinds[:, part, None], 4.0 * inverse_yield)
    return tuple(found[:, np.ravel(which)])


def _slope(z: np.ndarray, r: np.ndarray, b: np.ndarray, u: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return dB/dz."""
    sine, cosine = np.sin(z), np.cos(z)
    shape = np.sin(2.0 * z) / (2.0 * z)
    s = (1.0 - c * z * z) / (b * z * sine)
    ds = (-2.0 * c * z - b * s * (sine + z * cosine)) / (b * z * sine)
    bowing = 0.5 * s * ds * (1.0 + shape) + 0.25 * s * s * (np.cos(2.0 * z) - shape) / z
    return -2.0 * u * (ds * cosine - s * sine) - 8.0 * r * z - bowing


def _find(r: np.ndarray, b: np.ndarray, u: np.ndarray, inverse: float) -> np.ndarray:
    """Return both angles (2, b) of bars with numbers (b, 1): sign changes on a grid, then bisection."""
    c = inverse * r
    most = np.minimum(0.5 * np.pi, 1.0 / np.sqrt(c))
    share = np.linspace(0.0, 1.0, _POINTS + 1)[1:]
    z = most * share
    down = _slope(z, r, b, u, c) < 0.0
    rows = np.arange(len(r))
    first, last = down.argmax(axis=1), _POINTS - 1 - down[:, ::-1].argmax(axis=1)
    any_down = down.any(axis=1)
    ends = []
    for inside, step in ((last, 1), (first, -1)):
        outside = np.clip(inside + step, 0, _POINTS - 1)
        low, high = z[rows, inside][:, None], z[rows, outside][:, None]
        for _ in range(60):
            middle = 0.5 * (low + high)
            within = _slope(middle, r, b, u, c) < 0.0
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        ends.append(np.where(any_down, low[:, 0], 0.0))
    return np.array(ends)
