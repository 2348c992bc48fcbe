"""Datasets that grow by rows: their chunks and compression, and writes with few calls of HDF5."""

from __future__ import annotations

import functools

import h5py
import numpy as np

__all__ = ["Growing", "chunk_rows", "compressed_rows", "create_growing", "is_compressed"]

CHUNK_BYTES = 1 << 20
_LARGEST = 1 << 32  # bytes of a chunk of HDF5
# How many times smaller than CHUNK_BYTES compressed chunks may be.
_SMALLER = 64
# Level of compression: higher ones take two to ten times as long for a few percent.
_DEFLATE = 1


class Growing:
    """A dataset of a file that is open for writing.

    What HDF5 needs for a write of rows is looked up once: a write takes 3 µs and the time that its bytes take, instead
    of 15.

    Parameters
    ----------
    dataset : (rows, ...)

    Attributes
    ----------
    dtype : of the numbers
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._id, self._tail, self.dtype = dataset.id, dataset.shape[1:], dataset.dtype
        self._type = h5py.h5t.py_create(self.dtype)
        self._zeros = (0,) * len(self._tail)

    def grow(self, n_rows: int) -> None:
        """Set the number of rows. Collective for a shared file."""
        self._id.set_extent((n_rows, *self._tail))

    def write(self, first: int, rows: np.ndarray | None, collective: bool = False) -> None:
        """Write rows (n, ...) starting at row ``first``; None or no rows: join a collective transfer without data."""
        if rows is None and not collective:
            return
        target = self._id.get_space()
        if rows is None or rows.size == 0:
            rows = np.empty((1,) * (1 + len(self._tail)), dtype=self.dtype)
            source = h5py.h5s.create_simple(rows.shape)
            source.select_none()
            target.select_none()
        else:
            rows = np.ascontiguousarray(rows, dtype=self.dtype)
            source = h5py.h5s.create_simple(rows.shape)
            target.select_hyperslab((first, *self._zeros), rows.shape)
        self._id.write(source, target, rows, self._type, _collective() if collective else None)


@functools.cache
def _collective() -> h5py.h5p.PropDXID:
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    return transfer


def chunk_rows(n_rows: int, row_bytes: int) -> int:
    """Return the number of rows per chunk for blocks of ``n_rows`` rows: blocks up to 1 MiB, else equal parts.

    It depends on the global size only, so that files from any number of ranks have the same chunks. A divisor of the
    block is preferred, because then no chunk contains rows of two snapshots.
    """
    most = max(1, CHUNK_BYTES // row_bytes)
    if n_rows <= most:
        return max(1, n_rows)
    parts = -(-n_rows // most)
    for divisor in range(parts, 4 * parts):
        if n_rows % divisor == 0:
            return n_rows // divisor
    return -(-n_rows // parts)


def compressed_rows(n_rows: int, row_bytes: int) -> int:
    """Return the number of rows per compressed chunk for blocks of ``n_rows`` rows: always a divisor of the block.

    A chunk with rows of two snapshots would be written anew with the second one, and a kill would lose the first. If
    there is no divisor for chunks of 16 KiB to 1 MiB, a chunk is a whole block, unless HDF5 has no chunks of that size.
    """
    parts = max(1, -(-n_rows * row_bytes // CHUNK_BYTES))
    for divisor in range(parts, _SMALLER * parts):
        if n_rows % divisor == 0:
            return max(1, n_rows // divisor)
    return n_rows if n_rows * row_bytes < _LARGEST else chunk_rows(n_rows, row_bytes)


def is_compressed(dataset: h5py.Dataset) -> bool:
    """Return whether chunks pass filters on their way to the file."""
    return dataset.id.get_create_plist().get_nfilters() > 0


def create_growing(
    group: h5py.Group,
    name: str,
    row_shape: tuple[int, ...],
    dtype: np.dtype | type,
    rows_per_chunk: int,
    compressed: bool = False,
) -> h5py.Dataset:
    """Create an empty dataset (0, *row_shape) that grows by rows, and its parents. Collective for a shared file.

    ``compressed``: by gzip, which all readers of HDF5 have, after a shuffle of bytes: the high bytes of near values are
    alike.
    """
    shape = (0, *row_shape)
    space = h5py.h5s.create_simple(shape, (h5py.h5s.UNLIMITED, *row_shape))
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((rows_per_chunk, *(max(1, extent) for extent in row_shape)))
    if compressed:
        properties.set_shuffle()
        properties.set_deflate(_DEFLATE)
    # Parallel writes need chunks allocated when the dataset grows, also in a file created by one rank.
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    # Ranks would write zeros into new chunks, one chunk after the other; rows count only once they are written.
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    *parents, leaf = name.split("/")
    if parents:
        group = group.require_group("/".join(parents))
    made = h5py.h5d.create(
        group.id, leaf.encode(), h5py.h5t.py_create(np.dtype(dtype), logical=True), space, properties
    )
    return h5py.Dataset(made)
