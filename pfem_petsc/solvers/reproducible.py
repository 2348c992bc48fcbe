"""Options of PETSc with which multigrid is bitwise reproducible on several ranks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mpi4py import MPI
from petsc4py import PETSc

__all__ = ["reproducible_products"]


@contextmanager
def reproducible_products(comm: MPI.Comm) -> Iterator[None]:
    """Make coarse matrices by sums in an order that does not depend on when messages arrive, unless options ask for
    another way."""
    options = PETSc.Options()
    ours = comm.size > 1 and not options.hasName("matptap_via")
    if ours:
        # PETSc's default sums contributions of other ranks in the order of arrival
        options["matptap_via"] = "allatonce_merged"
    yield
    if ours:
        options.delValue("matptap_via")
