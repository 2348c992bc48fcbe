"""Named arrays that the fused loop reads and writes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mechanics.columns import Columns
from ..mechanics.sweep import Sweep

__all__ = ["BarArrays", "BlockArrays", "ImpulseArrays", "NodeArrays", "ProbeArrays", "StateArrays", "WallArrays"]


class BarArrays(NamedTuple):
    """Arguments of the bar loop of a law; see :mod:`~pfem_petsc.mechanics.kernels`. ``slack``: row of the history with
    the variable of this name, or -1; ``counted``: columns of the history that belong to counted bars; ``reach``: how
    many blocks of nodes beyond its own the bars of a block reach; ``columns`` of the bars, or none; ``planes`` and
    ``pulls`` (3 stride,): positions and forces by components, of a window of the nodes."""

    ends: np.ndarray
    sweep: Sweep
    far: np.ndarray
    rest: np.ndarray
    watched: np.ndarray
    heat: np.ndarray
    parameters: tuple
    area: float | np.ndarray
    history: np.ndarray
    slack: int
    counted: int
    reach: int
    meeting: int
    can_break: bool
    columns: Columns
    planes: np.ndarray
    pulls: np.ndarray


class NodeArrays(NamedTuple):
    """Constant arrays at the nodes; ``damping`` (0,) and ``external`` (0, 3) if there are none;
    ``support_starts`` (blocks + 1,) the first prescribed component of each block of nodes, which are sorted by node."""

    mass: np.ndarray
    damping: np.ndarray
    external: np.ndarray
    support_nodes: np.ndarray
    support_components: np.ndarray
    support_positions: np.ndarray
    support_starts: np.ndarray


class WallArrays(NamedTuple):
    """Flat walls and their log; see :mod:`~pfem_petsc.contact.flat` and :mod:`~pfem_petsc.contact.log`."""

    fixed: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    all_nodes: np.ndarray
    members: np.ndarray
    tolerance: float
    room: np.ndarray
    touching: np.ndarray
    present: np.ndarray
    releases: np.ndarray
    closed: np.ndarray
    restitution: np.ndarray
    slack: float


class BlockArrays(NamedTuple):
    """What the passes over blocks of nodes share: numbers of the scheme, see
    :mod:`~pfem_petsc.integrators._leapfrog`; positions ``x`` (local, 3) and velocities at half steps ``half`` (n, 3);
    ``inverses`` (n,) of the stiffness; ``factors``, ``speeds`` and ``drag``
    (3 NODE_BLOCK,) buffers of a block, the last one empty without damping; for prescribed components the increments
    ``held`` (k,) [m] and ``load`` (k,), the forces that would move them [N]; reactions ``support`` (n, 3) [N]; and
    ``lanes``, the sums of the balance, see :mod:`~pfem_petsc.stepping.balance_loops`."""

    h: float
    alpha: float
    eta: float
    x: np.ndarray
    half: np.ndarray
    inverses: np.ndarray
    factors: np.ndarray
    speeds: np.ndarray
    drag: np.ndarray
    held: np.ndarray
    load: np.ndarray
    support: np.ndarray
    lanes: np.ndarray


class ImpulseArrays(NamedTuple):
    """Particles (rows, 3) of :mod:`~pfem_petsc.stepping.impulses`: the scheme's memory and their state."""

    half: np.ndarray
    a: np.ndarray
    v: np.ndarray


class ProbeArrays(NamedTuple):
    """Nodes of all probes, see :meth:`~pfem_petsc.recording.recorder.Recorder.probed`."""

    nodes: np.ndarray
    places: np.ndarray
    counts: np.ndarray


class StateArrays(NamedTuple):
    """Arrays (n, 3) of the state, and the energies of the bars [J]. Wall forces are zero except at the nodes that touch
    walls; support forces are written at prescribed components alone."""

    f: np.ndarray
    a: np.ndarray
    v: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    energies: np.ndarray
