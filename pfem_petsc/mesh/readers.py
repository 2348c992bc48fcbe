"""The name under which programs import :func:`read_whole`; it is a function of :mod:`pfem_petsc.formats`."""

from ..formats import read_whole as read_whole
