"""Updates of ghosts within compiled loops: the persistent requests of the mesh, started and completed by MPI's own
functions."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from ..mechanics.compiled import kernel

__all__ = ["finish_positions", "start_positions"]

_INT, _SHORT, _BYTES = ir.IntType(64), ir.IntType(32), ir.IntType(8).as_pointer()


def _call(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Generate a call of the function at an address with the number of requests and pointers to arrays."""
    address, count, *arrays = values
    pointers = [
        context.make_array(kind)(context, builder, array).data
        for kind, array in zip(signature.args[2:], arrays, strict=True)
    ]
    kind = ir.FunctionType(_SHORT, [_SHORT] + [_BYTES] * len(pointers))
    function = builder.inttoptr(address, kind.as_pointer())
    arguments = [builder.trunc(count, _SHORT), *(builder.bitcast(pointer, _BYTES) for pointer in pointers)]
    return builder.call(function, arguments)


@intrinsic
def _start_all(typingctx, address, count, requests):  # noqa: ANN001, ANN201
    """Call ``MPI_Startall`` at an address; return its error code."""
    return types.int32(types.int64, types.int64, requests), _call


@intrinsic
def _wait_all(typingctx, address, count, requests, statuses):  # noqa: ANN001, ANN201
    """Call ``MPI_Waitall`` at an address; return its error code."""
    return types.int32(types.int64, types.int64, requests, statuses), _call


@kernel
def start_positions(messages, x, h, half):
    """Send the positions that owned nodes reach in a step, x + h ``half`` (owned, 3); return MPI's error code.

    ``messages``: a :class:`~pfem_petsc.mesh.exchange.Messages`.
    """
    rows, leaving = messages.rows, messages.leaving
    for k in range(len(rows)):
        i = rows[k]
        for c in range(3):
            leaving[k, c] = x[i, c] + h * half[i, c]
    return _start_all(messages.start_all, messages.count, messages.requests)


@kernel
def finish_positions(messages, x, before, fill):
    """Wait for the messages of :func:`start_positions`; if ``fill``, update the ghosts in ``x`` (local, 3), with their
    previous positions in ``before``. Return MPI's error code."""
    arriving = messages.arriving
    failed = _wait_all(messages.wait_all, messages.count, messages.requests, messages.statuses)
    first = len(x) - len(arriving)
    for k in range(len(arriving) if fill else 0):
        for c in range(3):
            before[first + k, c] = x[first + k, c]
            x[first + k, c] = arriving[k, c]
    return failed
