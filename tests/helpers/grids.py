"""Result files of a test truss, and checks of their content by readers."""

import numpy as np
import pyvista
from mpi4py import MPI
from vtkmodules.vtkIOHDF import vtkHDFReader

from helpers.truss import Truss, options, write
from pfem_petsc.output.vtkhdf import ResultWriter

COMM = MPI.COMM_WORLD
STEPS = range(23)


def write_all(path, comm=COMM, **changes):
    truss = Truss(comm, idle=(1,) if comm.size > 1 else ())
    with ResultWriter(path, comm, truss.mesh, **options(**changes)) as writer:
        write(writer, truss, STEPS)
    return truss


def read_with_vtk(path, step):
    """Return the grid of a step, and the number of steps, by the reader of VTK."""
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.SetStep(step)
    reader.Update()
    return pyvista.wrap(reader.GetOutputDataObject(0)), reader.GetNumberOfSteps()


def assert_grid_is(grid, truss, step):
    points, point_data, cell_data = truss.whole(step)
    np.testing.assert_array_equal(grid.points, points)
    np.testing.assert_array_equal(grid.cells.reshape(-1, 3)[:, 1:], truss.ends)
    assert set(grid.celltypes) == {pyvista.CellType.LINE}
    assert sorted(grid.point_data) == sorted(point_data)
    assert sorted(grid.cell_data) == sorted(cell_data)
    for name, values in point_data.items():
        np.testing.assert_array_equal(grid.point_data[name], values)
    for name, values in cell_data.items():
        np.testing.assert_array_equal(grid.cell_data[name], values)


def assert_history_is(history, truss, steps):
    assert sorted(history) == sorted(truss.row(0))
    for name in history:
        np.testing.assert_array_equal(history[name], [truss.row(step)[name] for step in steps])
