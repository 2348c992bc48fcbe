"""A law as a loop over a chunk of bars gives what its function of one bar gives."""

import math

import numpy as np
import pytest

from pfem_petsc.mechanics.chunk_laws import (
    CHUNK,
    HISTORY,
    MODULUS,
    ROW,
    STRAIN,
    STRAIN0,
    STRESS,
    TEMPERATURE,
    densities_row,
    flatten,
    law_loops,
    work_rows,
)
from pfem_petsc.mechanics.materials import damage, elastic, elastoplastic, multilinear
from pfem_petsc.mechanics.materials.base import damped, softened
from pfem_petsc.mechanics.rupture import breakable, limit_values

YOUNG = 70e9
PLASTIC = (YOUNG, 90e6, 3e9, 5e9, 1.0 / 78e9)
TABLE = np.array([[0.0, 1.0, 1.0], [100.0, 0.6, 0.5]])
CURVE = np.array([[0.0, 90e6, 2e9, 0.0], [1e-3, 92e6, 0.0, 91e3]])
LAWS = {
    "elastic": (elastic.LAW, (YOUNG,)),
    "softened and damped": (damped(softened(elastoplastic.LAW)), ((PLASTIC, TABLE), 70e5, 1.5)),
    "with a table": (multilinear.LAW, (YOUNG, 0.0, 1.0, CURVE)),
    "with data of bars": (damage.LAW, (YOUNG, 90e6, 90e6 / YOUNG)),
    "breakable": (breakable(elastoplastic.LAW), (*limit_values(None)[:4], 3e-3, math.inf, 1.0, *PLASTIC)),
}


@pytest.fixture(params=LAWS)
def bars(request):
    """A law, its numbers, and a workspace with bars of random strains, temperatures and histories."""
    law, numbers = LAWS[request.param]
    random = np.random.default_rng(5)
    work = np.zeros((work_rows(law), ROW))
    work[STRAIN, :CHUNK] = random.uniform(-4e-3, 4e-3, CHUNK)
    work[TEMPERATURE, :CHUNK] = random.uniform(-20.0, 120.0, CHUNK)
    names = [name for name, _ in law.rows]
    for name, largest in (("plastic_strain", 1e-3), ("accumulated_plastic_strain", 2e-3), ("last_strain", 4e-3)):
        if name in names:
            work[HISTORY + names.index(name), :CHUNK] = random.uniform(0.0, largest, CHUNK)
    if law.bar_data:
        work[HISTORY + len(names), :CHUNK] = random.uniform(5e-3, 2e-2, CHUNK)
    return law, numbers, work


def by_one(law, numbers, work, step, i):
    """What the function of the law gives of bar i."""
    data = work[HISTORY + len(law.rows) : densities_row(law), i].tolist()
    strain, rate, count = work[STRAIN, i], 0.0, len(law.internal)
    if law.rate and step > 0.0:
        rate = (strain - work[HISTORY + count, i]) / step
    q = tuple(work[HISTORY : HISTORY + count, i].tolist())
    return law.response(strain, rate, step, work[TEMPERATURE, i], (*numbers, *data), q)


def test_chunks_give_what_the_response_gives(bars):
    law, numbers, work = bars
    p, form = flatten(numbers)
    loops, count = law_loops(law, form), len(law.internal)
    before, brief = work.copy(), work.copy()
    loops.full(p, 1e-6, work.reshape(-1), CHUNK)
    loops.brief(p, 1e-6, brief.reshape(-1), CHUNK)
    written = [STRESS, *range(HISTORY, HISTORY + len(law.rows))]
    np.testing.assert_array_equal(work[written], brief[written])
    for i in range(0, CHUNK, 7):
        stress, modulus, new, densities = by_one(law, numbers, before, 1e-6, i)
        found = work[STRESS, i], work[MODULUS, i], *work[HISTORY : HISTORY + count, i], *work[densities_row(law) :, i]
        assert found == pytest.approx((stress, modulus, *new, *densities), rel=1e-12, abs=1e-12)
        if law.rate:
            assert work[HISTORY + count, i] == before[STRAIN, i]
            assert work[HISTORY + count + 1, i] == pytest.approx(stress, rel=1e-12)
    if law.rupture >= 0:
        assert 0 < np.count_nonzero(work[HISTORY + law.rupture]) < CHUNK


def test_mean_stresses_times_strains_are_the_work(bars):
    """From the strain at the start to that at the end, for laws whose energies are functions of state."""
    law, numbers, work = bars
    if law.rate or law.rupture >= 0 or law is multilinear.LAW:
        pytest.skip("its energies change otherwise")
    p, form = flatten(numbers)
    start = work.copy()
    start[STRAIN] *= 0.3
    loops = law_loops(law, form)
    first, last, mean = start.copy(), work.copy(), work.copy()
    loops.full(p, 0.0, first.reshape(-1), CHUNK)
    last[HISTORY:] = mean[HISTORY:] = first[HISTORY:]
    mean[STRAIN0] = start[STRAIN]
    loops.full(p, 0.0, last.reshape(-1), CHUNK)
    loops.mean(p, 0.0, mean.reshape(-1), CHUNK)
    densities = slice(densities_row(law), None)
    gained = (last[densities] - first[densities]).sum(axis=0)[:CHUNK]
    done = (mean[STRESS] * (work[STRAIN] - start[STRAIN]))[:CHUNK]
    np.testing.assert_allclose(done, gained, rtol=1e-9, atol=1e-9 * np.abs(gained).max())
