"""Everything that determines the future of a run, as arrays and numbers of a checkpoint.

Nodal arrays are those of the state, of the scheme's memory and of the stepper. Bar arrays are the data that material
laws keep, each variable under its name, thermal strains and prescribed rest lengths. Internal forces and energies are
saved rather than recomputed, because for a yielding bar a second evaluation may differ in the last digit. Sums of each
rank (works, energies, wall forces) are saved rank by rank and restored on the same number of ranks; on another number,
rank 0 gets the totals.

Where the data are stored:

- Arrays of the state: positions, velocities, accelerations, forces, and the scheme's memory (including tied nodes and
  changes by a treatment of impact).
- Arrays of the stepper: contacts with walls, nodes in contact in the last step, positions of the lagged preconditioner.
- Numbers of the stepper: level of bisection, part and smallest part of the step, counts of the lagged preconditioner.
- Arrays of the bars: data of the laws, thermal strains, rest lengths, history of the lagged preconditioner.
- ``free_walls``: walls with mass, including their last increment. Forces of pairs and
  constraints, and which of them are closed: arrays of their rows; with rows that come and go, the rows themselves.
- ``ranks``: works and energies. Recorder: energy at the start, largest energy, iterations since the last row.
  ``blow_up``: suspicious rows, energy input, energies of the first row. Contact log: contact times and impulses.
- Attributes (plan): time step and linear solver.

Newton's method, Krylov methods, candidates for contact and friction start from scratch in each step. Data that depend
on wall-clock time (synchronisation, progress, wall time) start from scratch in each run and do not affect the results.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..mechanics.bars import StrainEnergy
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from ..output.checkpoint import Checkpoint
from ..output.integrity import checksum
from ..parallel.natural import NaturalOrder
from ..stepping.model import StageStart

if TYPE_CHECKING:
    from ..stepping.stepper import Stepper

STATE_VERSION = 8
"""Changed with the meaning of what is saved."""

_MEMORY = "memory."
_KEPT = "stepper."
_LAW = "law."
_STAGE = "stage."


class RunState:
    """Collects and restores the state of a run. Construction is collective.

    Parameters
    ----------
    stepper : Stepper
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        self.comm, self.mesh = self.model.comm, self.model.mesh

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        """Return name to (order, rows owned by this rank) of all arrays; the same names on all ranks."""
        own = self._node_arrays()
        # arrays of a scheme or a treatment may exist only on some ranks
        kinds: dict[str, tuple[tuple[int, ...], str]] = {}
        for other in self.comm.allgather({name: (array.shape[1:], array.dtype.str) for name, array in own.items()}):
            kinds |= other
        for name in kinds.keys() - own.keys():
            shape, kind = kinds[name]
            own[name] = np.zeros((self.mesh.n_owned, *shape), dtype=kind)
        nodes = {name: (self.mesh.node_order, own[name]) for name in sorted(kinds)}
        bars = {name: (self.mesh.bar_order, array[self.mesh.counted]) for name, array in self._bar_arrays().items()}
        return {**nodes, **bars, **self.model.links.arrays()}

    def scalars(
        self, ledger: Mapping[str, Any], history: Mapping[str, Any], snapshots: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the numbers, with what this rank's ledger, the history and the snapshots keep. Collective."""
        stepper, energy, walls = self.stepper, self.stepper.energy, self.stepper.solution.walls
        mine = {
            "ledger": ledger,
            "energy": list(energy.energies),
            "walls": {name: getattr(walls, name).tolist() for name in walls.sums},
            "contact_log": self.model.contact.log.share(),
            "contacts": int(stepper.solution.contacts),
        }
        memories = self.comm.allgather(sorted(stepper.state.memory))
        return {
            "step": stepper.number,
            "time": stepper.state.time,
            "stepper": {name: getattr(stepper, name) for name in stepper.kept_numbers},
            **{name: kept for name, kept in history.items() if name != "row"},
            **self.model.links.numbers(),
            "free_walls": self.model.contact.motion.bodies.kept(),
            "contact_times": self.model.contact.log.times(self.comm),
            "row": history["row"],
            **snapshots,
            "node_arrays": sorted(set().union(*self.comm.allgather(set(self._node_arrays())))),
            "memories": memories,
            "bar_arrays": sorted(self._bar_arrays()),
            "ranks": self.comm.allgather(mine),
        }

    @cached_property
    def mesh_mark(self) -> int:
        """Checksum of coordinates and bar ends, the same on any number of ranks. Collective at first use."""
        mesh, nodes, bars = self.mesh, self.mesh.node_order, self.mesh.bar_order
        points = nodes.to_slab(mesh.points[: mesh.n_owned])
        ends = mesh.node_ids[mesh.bars[mesh.counted]].astype(np.int64, copy=False).reshape(-1, 2)
        return checksum(self.comm, points, nodes.first) ^ checksum(self.comm, bars.to_slab(ends), bars.first)

    def restore(self, file: Checkpoint, source: str) -> None:
        """Restore the stepper from a checkpoint, instead of its ``start``, and close the file. Collective.

        ``source``: the case's file, for the message

        Raises
        ------
        InputError
            On all ranks, if the checkpoint is damaged or belongs to another mesh: the content of a mesh file may have
            changed.
        """
        if file.attributes.get("mesh_mark") != self.mesh_mark:
            raise InputError(
                f"{file.path}: the mesh of {source} is not the one that it was written with (other nodes or bars): "
                "restore the mesh, or start without --restart"
            )
        arrays = file.read(self.orders(file.scalars))
        file.close()
        self._load_state(file.scalars, arrays)

    def orders(self, scalars: dict[str, Any]) -> dict[str, NaturalOrder]:
        """Return the orders of the arrays of a checkpoint with these numbers: nodal rows by owner, bars in slabs."""
        mine = self.mesh.bar_order
        bars = NaturalOrder(self.comm, np.arange(mine.first, mine.first + mine.count), self.mesh.n_bars)
        orders = dict.fromkeys(scalars["node_arrays"], self.mesh.node_order)
        orders |= dict.fromkeys(scalars["bar_arrays"], bars)
        return orders | self.model.links.orders(scalars.get("rows"))

    def _load_state(self, scalars: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        stepper, state, owned = self.stepper, self.stepper.state, self.mesh.n_owned
        if scalars.get("stage") is not None and scalars["stage"]["start"] is not None:
            held = {name.removeprefix(_STAGE): a for name, a in arrays.items() if name.startswith(_STAGE)}
            self.model.begin_stage(StageStart.restored(scalars["stage"]["start"], held))
        for name in scalars["node_arrays"]:
            values = arrays[name]
            if name.startswith(_STAGE):
                continue
            if name.startswith(_MEMORY):
                state.memory[name.removeprefix(_MEMORY)] = values.copy()
            elif name.startswith(_KEPT):
                name = name.removeprefix(_KEPT)
                setattr(stepper, name, values.astype(getattr(stepper, name).dtype))
            elif name in ("x", "f"):
                getattr(state, name)[:owned] = values
            else:
                # not in place: an absent force may be a shared array
                setattr(state, name, values.copy())
        if len(scalars["memories"]) == self.comm.size:
            mine = scalars["memories"][self.comm.rank]
            state.memory = {name: array for name, array in state.memory.items() if name in mine}
        self.mesh.update_ghosts(state.x)
        self._load_bars({name: arrays[name] for name in scalars["bar_arrays"]})
        state.step, state.time = int(scalars["step"]) - self.model.first_step, float(scalars["time"])
        for name, value in scalars["stepper"].items():
            setattr(stepper, name, value)
        mine = self.share(scalars["ranks"])
        stepper.energy = StrainEnergy(tuple(float(value) for value in mine["energy"]))
        walls = stepper.solution.walls
        like = {name: getattr(walls, name) for name in mine["walls"]}
        sums = {n: np.array(mine["walls"][n], dtype=a.dtype).reshape(a.shape) for n, a in like.items()}
        stepper.solution.walls = dataclasses.replace(walls, **sums)
        stepper.solution.contacts = int(mine["contacts"])
        self.model.contact.motion.bodies.load_state(scalars["free_walls"])
        self.model.links.load_state(arrays)
        self.model.contact.log.load_state(mine["contact_log"], scalars["contact_times"], stepper.touching)
        stepper.resume()

    def share(self, ranks: list[dict[str, Any]]) -> dict[str, Any]:
        """Return this rank's share of the sums: its own on the same number of ranks, else all on rank 0."""
        if len(ranks) == self.comm.size:
            return ranks[self.comm.rank]
        return _summed(ranks) if self.comm.rank == 0 else _summed(ranks[:1], 0.0)

    def _node_arrays(self) -> dict[str, np.ndarray]:
        """Return the rows of owned nodes, by name, of every array of the state, including any added later."""
        state, owned = self.stepper.state, self.mesh.n_owned
        fields = {item.name: getattr(state, item.name) for item in dataclasses.fields(state)}
        found = {name: value[:owned] for name, value in fields.items() if isinstance(value, np.ndarray)}
        found |= {_MEMORY + name: array for name, array in state.memory.items()}
        kept = {name: getattr(self.stepper, name) for name in self.stepper.kept_arrays}
        found |= {_KEPT + name: a.astype(np.uint8) if a.dtype == bool else a for name, a in kept.items()}
        if self.model.start is not None:
            found |= {_STAGE + name: array for name, array in self.model.start.arrays().items()}
        # a case without walls has no columns for them
        return {name: array for name, array in found.items() if 0 not in array.shape[1:]}

    def _bar_arrays(self) -> dict[str, np.ndarray]:
        """Return the rows of all local bars, by name."""
        bars = self.model.bars
        found = {}
        if bars.kept_names:
            found |= {_LAW + name: values for name, values in zip(bars.kept_names, bars.history().T, strict=True)}
        if self.model.temperatures.any:
            found |= {"thermal_strain": bars.heat[0], "temperature": self.model.temperatures.values}
        if self.model.rest_lengths.any:
            found["rest_length"] = bars.rest
        kept = {_KEPT + name: getattr(self.stepper, name) for name in self.stepper.kept_bars}
        return found | {name: array for name, array in kept.items() if array.shape[1]}

    def _load_bars(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore the bar arrays; bars evaluated on two ranks get the same values on both."""
        mesh, bars = self.mesh, self.model.bars
        asking = Router(self.comm, slab_of(mesh.bar_ids, mesh.n_bars, self.comm.size))
        asked = asking.send(mesh.bar_ids) - self.mesh.bar_order.first
        history = bars.history()
        for name, array in arrays.items():
            values = asking.reply(array[asked])
            if name.startswith(_LAW):
                history[:, bars.kept_names.index(name.removeprefix(_LAW))] = values
            elif name.startswith(_KEPT):
                setattr(self.stepper, name.removeprefix(_KEPT), values)
            else:
                own = {"thermal_strain": bars.heat[:1], "temperature": bars.heat[1:], "rest_length": bars.rest}
                own[name][:] = values
        bars.put_history(history)
        self.model.temperatures.hold(bars.heat)


def _summed(shares: list[Any], factor: float = 1.0) -> Any:
    """Return sums over ranks, times a factor, in the same nested dictionaries."""
    if isinstance(shares[0], dict):
        return {name: _summed([share[name] for share in shares], factor) for name in shares[0]}
    return factor * sum(np.array(share) for share in shares)
