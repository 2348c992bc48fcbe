"""OpenSeesPy on the lattice: corotational trusses; usage: run_openseespy.py CELLS MODE STEPS [SYSTEM OF EQUATIONS].

With contact the bars are Steel01 (kinematic hardening), and stiff springs that only push (ENT) stand for the wall: a
penalty. Without, bars are elastic and the foot is held along z.
"""

from __future__ import annotations

import model as m
import numpy as np
import openseespy.opensees as ops

STRUT, SPRING = 1, 2


def build(points: np.ndarray, bars: np.ndarray, contact: bool) -> None:
    """Nodes, bars, wall and initial velocities."""
    ops.wipe()
    ops.model("basic", "-ndm", 3, "-ndf", 3)
    mass = m.lumped_mass(points, bars)
    for node, point in enumerate(points.tolist()):
        ops.node(node, *point)
        ops.mass(node, *[float(mass[node])] * 3)
    if contact:
        ops.uniaxialMaterial("Steel01", STRUT, m.YIELD_STRESS, m.YOUNG_MODULUS, m.HARDENING_RATIO)
    else:
        ops.uniaxialMaterial("Elastic", STRUT, m.YOUNG_MODULUS)
    for bar, (a, b) in enumerate(bars.tolist()):
        ops.element("corotTruss", bar, a, b, m.AREA, STRUT)
    foot = points[:, 2] == 0.0
    if contact:
        ops.uniaxialMaterial("ENT", SPRING, 10.0 * m.YOUNG_MODULUS * m.AREA / m.PITCH)
        for count, node in enumerate(np.flatnonzero(foot).tolist()):
            ground = len(points) + count
            ops.node(ground, *points[node].tolist())
            ops.fix(ground, 1, 1, 1)
            ops.element("zeroLength", len(bars) + count, ground, node, "-mat", SPRING, "-dir", 3)
    else:
        for node in np.flatnonzero(foot).tolist():
            ops.fix(node, 0, 0, 1)
    for node in np.flatnonzero(~foot | contact).tolist():
        ops.setNodeVel(node, 3, m.SPEED, "-commit")


def main() -> None:
    """Run and report."""
    cells, mode, steps, system = m.arguments()
    points, bars = m.truss(cells)
    contact, explicit = mode.endswith("contact"), mode.startswith("explicit")
    build(points, bars, contact)
    ops.constraints("Plain")
    ops.numberer("Plain" if explicit else "AMD")
    ops.system("Diagonal" if explicit else system)
    if explicit:
        ops.algorithm("Linear")
        ops.integrator("ExplicitDifference")
    else:
        ops.test("NormDispIncr", 1e-8, 20, 0)  # 2-norm of the last correction [m]
        ops.algorithm("Newton")
        ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    h = m.EXPLICIT_STEP if explicit else m.IMPLICIT_STEP

    def step() -> float:
        if ops.analyze(1, h) != 0:
            raise RuntimeError("OpenSees did not converge")
        return 0.0 if explicit else float(ops.testIter())

    times = m.time_steps(step, steps)
    m.report(times, len(bars), ops.nodeDisp(len(points) - 1, 3))


main()
