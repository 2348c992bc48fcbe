"""A run from case to results: set-up, time loop, output."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from .errors import InputError, PfemError, SimulationFailure
from .output.progress import Progress
from .output.units import engineering
from .output.vtkhdf import ResultWriter
from .parallel.agreement import agreed, on_root
from .parallel.natural import NaturalOrder
from .stepping.ledger import Ledger
from .stepping.model import Model
from .stepping.prepare import make_plan, make_stepper
from .stepping.recorder import Recorder

__all__ = ["Simulation", "Step"]

POINT_FIELDS = ("displacement", "velocity", "acceleration", "contact_force")
CELL_FIELDS = ("strain", "stress", "axial_force", "plastic_strain", "temperature")
_MEETING = 20  # steps between agreements on faults where no history row brings the ranks together


class Step(NamedTuple):
    """What a finished step reports."""

    step: int
    time: float
    newton: int
    linear: int
    row: dict[str, Any] | None


class Simulation:
    """A case on a communicator.

    Parameters
    ----------
    case : Case
    comm : MPI.Comm, optional
        Default: the world.
    output : Path or None
        Folder of the results; default ``results/<case name>``. Results found there are moved aside.
    restart : None, True or Path
        Continue from the newest checkpoint of the output folder, or from a file.
    quiet : bool
        Print nothing on stdout.
    wall_time : float, optional
        Stop with a checkpoint after so many seconds.
    check_only : bool
        Set the model up and write nothing.

    Raises
    ------
    InputError
        On all ranks.
    """

    def __init__(
        self,
        case,
        comm: MPI.Comm | None = None,
        output: Path | str | None = None,
        restart: bool | Path | None = None,
        quiet: bool = False,
        wall_time: float | None = None,
        check_only: bool = False,
    ) -> None:
        self.case = case
        self.comm = comm if comm is not None else MPI.COMM_WORLD
        self.folder = Path(output) if output is not None else Path("results") / case.name
        self.quiet = quiet
        self.model = Model(case, self.comm)
        self.plan = make_plan(self.model)
        self.model.contact.check_start(self.model.mesh.points[: self.model.mesh.n_owned], self.model.length)
        self.stepper = make_stepper(self.model, self.plan)
        self.row: dict[str, Any] | None = None
        self._started = False
        self._writer: ResultWriter | None = None
        self._progress: Progress | None = None
        self._next_meeting = _MEETING

    @property
    def state(self):  # noqa: ANN201
        """The state of this rank's nodes: :class:`~pfem_petsc.integrators.base.State`."""
        return self.stepper.state

    @property
    def mesh(self):  # noqa: ANN201
        """The distributed mesh."""
        return self.model.mesh

    def summary(self) -> dict[str, str]:
        """Label and text of what a user checks before a run. Collective."""
        model, plan, case = self.model, self.plan, self.case
        mesh = model.mesh
        counts = self.comm.allgather((mesh.n_owned, mesh.n_local - mesh.n_owned))
        critical = engineering(plan.critical_step, "s") if np.isfinite(plan.critical_step) else "none (implicit)"
        parameters = ", ".join(f"{k} = {v:g}" for k, v in case.time.scheme.model_dump().items())
        entries = {
            "nodes": f"{mesh.n_nodes:,}",
            "bars": f"{mesh.n_bars:,}",
            "ranks": f"{self.comm.size}, owning {min(c[0] for c in counts):,} to {max(c[0] for c in counts):,} nodes "
            f"({mesh.partitioner}), at most {max(c[1] for c in counts):,} ghosts",
            "extent": " x ".join(engineering(float(d), "m") for d in model.high - model.low),
            "mass": engineering(model.total_mass, "kg") + f" ({case.time.mass})",
            "wave speed": engineering(model.wave_speed, "m/s"),
            "integrator": case.time.integrator + (f" ({parameters})" if parameters else ""),
            "critical step": critical,
            "time step": f"{engineering(plan.step, 's', 6)}, {plan.steps:,} steps to "
            f"{engineering(plan.step * plan.steps, 's')}",
            "linear solver": plan.linear.why if plan.linear is not None else "none: every node on its own",
            "walls": ", ".join(model.contact.names) or "none",
            "memory": self._memory(),
        }
        return entries

    def _memory(self) -> str:
        import resource

        # kibibytes on Linux
        peak = self.comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0)
        return f"{engineering(peak, 'B', 3)} in use on all ranks"

    def start(self) -> None:
        """Complete the state at t = 0 and open the output. Collective; called by :meth:`run` and iteration."""
        if self._started:
            return
        self._started = True
        self._prepare_folder()
        self._progress = Progress(
            self.comm,
            self.case.title,
            self.plan.steps,
            self.plan.step * self.plan.steps,
            self.quiet,
            self.folder / "log.txt",
        )
        self._progress.summary(self.summary())
        for warning in self.model.warnings:
            self._progress.warning(warning)
        if self.plan.scheme.notice:
            self._progress.message(self.plan.scheme.notice)
        self.stepper.start()
        self._agree_on_faults()
        self.ledger = Ledger(self.stepper)
        self.stepper.booking = self.ledger.update
        if hasattr(self.stepper, "message"):
            self.stepper.message = self._progress.warning
        self.recorder = Recorder(self.stepper, self.ledger)
        fields = self.case.output.fields
        self.point_fields = [n for n in POINT_FIELDS if fields is None or n in fields]
        heated = self.model.temperatures.any
        self.cell_fields = [
            n for n in CELL_FIELDS if (n in fields if fields is not None else n != "temperature" or heated)
        ]
        self._writer = ResultWriter(
            self.folder / "result.vtkhdf",
            self.comm,
            self.mesh,
            point_fields=self.point_fields,
            cell_fields=self.cell_fields,
            columns=self.recorder.columns,
            column_types=self.recorder.types,
            case_text=self.case.to_toml(),
            attributes=self._attributes(),
            precision=self.case.output.precision,
        )
        self._record()
        self._snapshot()

    def _attributes(self) -> dict[str, Any]:
        plan = self.plan
        attributes: dict[str, Any] = {
            "name": self.case.name,
            "folder": str(self.case.folder.resolve()),
            "time_step": plan.step,
            "steps": plan.steps,
            "linear_solver": plan.linear.why if plan.linear is not None else "none",
            "partitioner": self.mesh.partitioner,
        }
        for name, nodes in self.recorder.probe_nodes.items():
            attributes[f"probe_nodes/{name}"] = nodes.tolist()
        return attributes

    def __iter__(self) -> Iterator[Step]:
        """Run step by step; the output is closed when the iteration ends."""
        try:
            self.start()
            while self.state.step < self.plan.steps:
                yield self._advance()
            self._finish("done")
        except GeneratorExit:
            self._finish("stopped")
            raise
        except PfemError:
            self._finish("failed")
            raise
        except BaseException:
            # one rank alone may be here: nothing collective is safe
            if self._progress is not None:
                self._progress.close("failed")
            raise

    def run(self) -> int:
        """Run to the end and give the exit status. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks; what was recorded before is in the result file.
        """
        for _ in self:
            pass
        return 0

    def _advance(self) -> Step:
        stepper, output = self.stepper, self.case.output
        stepper.step()
        solution = stepper.solution
        self.recorder.count(solution.newton, solution.linear)
        step = self.state.step
        last = step == self.plan.steps
        row = None
        if step % output.history_every == 0 or last:
            row = self._record()
        elif step >= self._next_meeting:
            self._agree_on_faults()
        if last or (output.fields_every and step % output.fields_every == 0):
            self._snapshot()
        drift = self.row["energy_imbalance"] / max(abs(self.recorder.start_energy), 1e-300)
        self._progress.update(
            step, self.state.time, stepper.h, solution.newton, solution.linear, self.row["active_contacts"], drift
        )
        return Step(step, self.state.time, solution.newton, solution.linear, row)

    def _record(self) -> dict[str, Any]:
        self._agree_on_faults()
        self.row = self.recorder.row()
        energy = self.row["kinetic_energy"] + self.row["elastic_energy"]
        if not np.isfinite(energy):
            raise SimulationFailure(
                f"step {self.state.step}, t = {self.state.time:.6g} s: the energy is not finite: the motion blew up; take "
                "a smaller time.step"
            )
        self._writer.append_history(self.row if self.comm.rank == 0 else None)
        return self.row

    def _agree_on_faults(self) -> None:
        self._next_meeting = self.state.step + _MEETING
        with agreed(self.comm):
            if self.stepper.fault is not None:
                raise self.stepper.fault

    def _snapshot(self) -> None:
        if not self.case.output.fields_every and 0 < self.state.step < self.plan.steps:
            return
        state, owned = self.state, self.mesh.n_owned
        position = state.position
        points = {
            "displacement": lambda: position - self.mesh.points[:owned],
            "velocity": lambda: state.v,
            "acceleration": lambda: state.a,
            "contact_force": lambda: state.contact,
        }
        bars = self.model.bars.fields(state.x) if self.cell_fields else {}
        if "temperature" in self.cell_fields:
            bars["temperature"] = (
                self.model.temperatures.values if self.model.temperatures.any else 0.0 * bars["strain"]
            )
        self._writer.write_snapshot(
            state.time,
            state.step,
            position,
            {name: points[name]() for name in self.point_fields},
            {name: bars[name] for name in self.cell_fields},
        )

    def _finish(self, outcome: str) -> None:
        if self._writer is not None:
            try:
                self._writer.flush_history()
            except SimulationFailure:
                if outcome == "done":
                    raise
            self._writer.close()
            self._writer = None
        if self._progress is not None:
            self._progress.close(outcome)

    def gather(self, values: np.ndarray) -> np.ndarray | None:
        """An owned array (owned, ...) as a whole in mesh numbering on rank 0, None elsewhere. Collective."""
        order = NaturalOrder(self.comm, self.mesh.node_ids[: self.mesh.n_owned], self.mesh.n_nodes)
        parts = self.comm.gather(order.to_slab(values))
        return np.concatenate(parts) if parts is not None else None

    def _prepare_folder(self) -> None:
        """Make the output folder; results found there are moved aside to a numbered name."""
        on_root(self.comm, _prepare_folder, self.folder)


def _prepare_folder(folder: Path) -> None:
    try:
        if (folder / "result.vtkhdf").exists():
            number = 1
            while (aside := folder.with_name(f"{folder.name}.{number}")).exists():
                number += 1
            folder.rename(aside)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot write the results there: {error.strerror}; choose another with -o"
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot write the results there: permission denied; choose another with -o")
