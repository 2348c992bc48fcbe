"""The plan of a run: scheme, time step and linear solver, resolved once before the first step; and its stepper."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..contact.free_walls import FreeWalls
from ..contact.impact_gains import warn_of_gain
from ..contact.treatments.base import Restitution, Treatment
from ..errors import InputError
from ..integrators.base import Scheme
from ..mechanics.bars import viscous_rate
from ..mechanics.materials.base import law_name, law_of
from ..output.units import TIME as AXIS
from ..output.units import Axis, engineering
from ..registry import choices, lookup
from ..solvers.matrix_free import BarProducts
from ..tolerances import TIME
from .explicit import ExplicitStepper, RedistributedStepper

if TYPE_CHECKING:
    from ..case.base import SurfaceKeys
    from ..case.schema import Case
    from ..solvers.linear import LinearChoice
    from .model import Model
    from .stepper import Stepper


_LARGEST = 1e150  # squared frequencies [rad2/s2] whose squares do not overflow


class Frequency(NamedTuple):
    """Bounds on the highest angular frequency [rad/s]: ``lower`` is rigorous, ``upper`` is based on Lanczos' residual.

    Infinite if stiffness over mass overflows double precision.
    """

    lower: float
    upper: float


@np.errstate(over="ignore", invalid="ignore")
def highest_frequency(model: Model, x: np.ndarray, steps: int = 60, accuracy: float = 1e-4) -> Frequency:
    """Compute the highest natural frequency at positions ``x`` by Lanczos' method on M^-1/2 K_t M^-1/2. Collective.

    M is the lumped mass. The limit l/c of a single bar is a safe bound on the critical step for unstressed bars only,
    and often too small. The largest Ritz value is a lower bound of the squared frequency, and its residual bounds the
    distance to an eigenvalue. With consistent mass the element matrix of a bar is at least a third of its lumped one,
    so the squared frequency is at most three times as high; it is at least the Rayleigh quotient of the Ritz vector.

    Parameters
    ----------
    model : Model
    x : (local, 3) positions with ghosts [m]
    steps : maximum number of Lanczos steps
    accuracy : relative residual at which the iteration stops
    """
    mesh, comm = model.mesh, model.comm
    owned = mesh.n_owned
    supports = model.supports
    with np.errstate(divide="ignore"):
        scale = np.where(supports.fixed, 0.0, 1.0 / np.sqrt(model.inertia.mass)[:, None])
    # the start vector is a hash of node and component: independent of the number of ranks, with all wave lengths
    ids = mesh.node_ids[:owned, None].astype(np.uint64) * np.uint64(3) + np.arange(3, dtype=np.uint64)
    hashed = (ids + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    hashed ^= hashed >> np.uint64(29)
    q = (hashed >> np.uint64(11)).astype(np.float64) / 2.0**53 - 0.5
    supports.clear(q)

    # what each step would allocate is allocated once: the pages of large arrays are requested anew each time
    local, product = np.zeros((2, mesh.n_local, 3))
    w, room = np.empty((2, owned, 3))

    def dot(u: np.ndarray, v: np.ndarray) -> float:
        return comm.allreduce(float(np.multiply(u, v, out=room).sum()))

    def norm(u: np.ndarray) -> float:
        return float(np.sqrt(dot(u, u)))

    size = norm(q)
    if size == 0.0:
        return Frequency(0.0, 0.0)
    q /= size
    previous = np.zeros_like(q)
    products, no_inertia = BarProducts.tangent(model.bars, x), np.zeros(owned)
    diagonal: list[float] = []
    beside: list[float] = []
    low = high = 0.0
    basis: list[np.ndarray] = []
    for _ in range(min(steps, 3 * mesh.n_nodes)):
        if model.inertia.consistent:
            basis.append(q.copy())
        np.multiply(scale, q, out=local[:owned])
        mesh.update_ghosts(local)
        products.times(no_inertia, local, product)
        for family in model.bars.families:
            family.add_product(1.0, local, product)
        np.multiply(scale, product[:owned], out=w)
        supports.clear(w)
        alpha = dot(w, q)
        w -= np.multiply(alpha, q, out=room)
        if beside:
            w -= np.multiply(beside[-1], previous, out=room)
        beta = norm(w)
        diagonal.append(alpha)
        matrix = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
        if not np.isfinite(matrix).all() or np.abs(matrix).max() > _LARGEST:
            return Frequency(np.inf, np.inf)
        values, vectors = np.linalg.eigh(matrix)
        ritz, residual = values[-1], beta * abs(vectors[-1, -1])
        low, high = max(ritz, 0.0), max(ritz + residual, 0.0)
        if residual <= accuracy * max(ritz, 0.0) or beta <= 1e-14 * max(abs(ritz), 1e-300):
            break
        beside.append(beta)
        previous, q, w = q, np.divide(w, beta, out=w), previous
    if model.inertia.consistent and low > 0.0:
        shape = scale * sum(weight * vector for weight, vector in zip(vectors[:, -1], basis))
        low /= comm.allreduce(float((shape * model.inertia.mass_times(shape, np.empty_like(shape))).sum()))
        high *= 3.0
    return Frequency(float(np.sqrt(low)), float(np.sqrt(high)))


_LEAST = 1e-6  # ratio of frequency and rate of damping below which the frequency no longer changes the stable step
WITH_CONTACT = 0.75  # factor on automatic steps where bars touch, whose stiffness it leaves room for
_MOST_STEPS = 2.0**53  # beyond this, consecutive steps do not have distinct times


@dataclass(frozen=True)
class Plan:
    """The resolved settings of a run.

    Attributes
    ----------
    scheme : the integrator, or the balance without inertia
    axis : of the times in the results
    texts : summary for the user before a run, by label
    step : time step [s], or first increment on the axis
    end : last place on the axis, None where it is not known before
    linear : linear solver, None where every node is solved on its own
    steps : largest number of steps, None where it is not known before
    critical_step : largest stable step of the scheme [s], infinite if unconditionally stable
    frequency : bounds on the highest natural frequency [rad/s], None without motion
    record : the numbers that a restart must not compute again, exact to the last bit
    stages : the plans of the stages that this one joins; empty without stages
    """

    scheme: Scheme
    axis: Axis
    texts: dict[str, str]
    step: float = 0.0
    end: float | None = 0.0
    linear: LinearChoice | None = None
    steps: int | None = None
    critical_step: float = np.inf
    frequency: Frequency | None = None
    record: dict[str, Any] = field(default_factory=dict)
    stages: tuple[Plan, ...] = ()

    def beyond(self, times: np.ndarray) -> np.ndarray:
        """Return which of the recorded times are beyond the end."""
        return times > (np.inf if self.end is None else self.end * (1.0 + TIME))


def refuse_motion(case: Case, what: str) -> None:
    """Refuse initial velocities, restitution and treatments of impact, which ``what`` does not have."""
    if any(any(entry.velocity) or any(entry.angular_velocity) for entry in case.initial):
        raise InputError(f"{case.source}: initial: {what} has no velocities; remove the table [initial], or use [time]")
    if not any(stage.time is not None for stage in case.editor[0].stages):
        _refuse_restitution(case, what)
    name = case.contact.treatment
    if name == "scheme":
        return
    remedy, where = "remove the key", ""
    if case.editor[0].stage:
        where = f"stage {case.name!r}: "
        remedy = (
            "move it to [stage.contact] of the stages with [stage.time]; as tables stay in force, a stage with "
            '[stage.static] after those has [stage.contact] with treatment = "scheme"'
        )
    raise InputError(
        f'{case.source}: {where}contact.treatment = "{name}" treats impacts, and {what} has none; {remedy}'
    )


def _refuse_restitution(case: Case, what: str) -> None:
    """Refuse restitution of walls, pairs and bars, which ``what`` does not have. As tables stay in force, stages may
    have it beside one with time."""
    named: list[tuple[str, float]] = []
    for kind in ("wall", "contact_pair"):
        named += [(f"{kind} {entry.name!r}", entry.restitution) for entry in getattr(case, kind) if entry.restitution]
    if case.self_contact is not None and case.self_contact.restitution != 1.0:
        named.append(("self_contact", case.self_contact.restitution))
    for key, value in named[:1]:
        raise InputError(
            f"{case.source}: {key}: restitution = {value:g} is of impacts, and {what} has none; remove the key, or use "
            "[time]"
        )


def make_plan(model: Model, recorded: Mapping[str, Any] | None = None) -> Plan:
    """Resolve the settings that the case leaves open. Collective.

    Parameters
    ----------
    model : Model
    recorded : :attr:`Plan.record` of the run that is continued, whose time step and frequencies are kept

    Raises
    ------
    InputError
        On all ranks, if the step is certainly unstable.
    """
    case = model.case
    time = case.time
    scheme = lookup("pfem_petsc.integrators", time.integrator, f"{case.source}: time.integrator").Scheme(time.scheme)
    _check_laws(case, scheme)
    kept = recorded or {}
    frequency = Frequency(*kept["frequency"]) if kept else _highest_frequency(model)
    if not np.isfinite(frequency.upper):
        raise InputError(
            f"{case.source}: material: the stiffness of the bars over their mass overflows double precision: correct "
            "young_modulus, density and area (SI units)"
        )
    # mass-proportional damping: xi = c_m / (2 rho omega) is largest for the largest c_m / rho
    least = max(frequency.lower or frequency.upper, 1e-300)
    ratio = model.inertia.largest_factor * max(m.damping / m.density for m in case.material.values()) / (2.0 * least)
    limit = scheme.limit(min(ratio, 1e3))
    local = dashpot_rate(model) / (2.0 * least)  # of single nodes, not of all modes
    if limit == 0.0:
        raise InputError(
            f"{case.source}: time: {time.integrator} with these parameters is unstable at any step; use gamma >= 1/2"
        )
    betas = [case.material[section.material].stiffness_damping for section in case.section.values()]
    viscous = viscous_rate(case, model.bars, model.inertia.mass, model.inertia.consistent)
    critical = _stable_step(scheme, min(ratio + local, 1e3), frequency.upper, max(betas), viscous)
    certain = _stable_step(scheme, min(ratio, 1e3), frequency.lower, min(betas))
    if kept:
        step = float(kept["step"])
    elif time.step == "auto":
        if not np.isfinite(critical):
            raise InputError(
                f'{case.source}: time.step = "auto": {time.integrator} has no critical step here, as neither bars nor '
                "springs resist the free nodes; give time.step [s]"
            )
        safety = time.safety if model.self_contact is None else WITH_CONTACT * time.safety
        step = time.end / _steps_to(time.end, safety * critical, case.source)
    else:
        step = float(time.step)
        if step > certain * (1.0 + TIME):
            raise InputError(
                f"{case.source}: time.step = {step:g} s is above the limit of {time.integrator}, which is unstable "
                f'beyond {critical:.6g} s for this model; reduce it, or use time.step = "auto"'
            )
        if step > time.end * (1.0 + TIME):
            model.warnings.append(
                f"time.step = {step:g} s is longer than time.end = {time.end:g} s: the run makes one step, "
                f"to t = {step:g} s"
            )
    steps = _steps_to(time.end, step, case.source)
    asked = case.solver.linear, case.solver.operator
    linear = None
    if not scheme.explicit or model.inertia.consistent:
        known = kept.get("linear")
        if known is not None and tuple(known["asked"]) == asked:
            from ..solvers.linear import LinearChoice

            linear = LinearChoice(**known["choice"])
        else:
            linear = _linear(model, scheme, 0.0 if scheme.explicit else step * frequency.upper / 2.0, steps)
    parameters = ", ".join(f"{key} = {value:g}" for key, value in time.scheme.model_dump().items())
    texts = {
        "integrator": time.integrator + (f" ({parameters})" if parameters else ""),
        "critical step": engineering(critical, "s") if np.isfinite(critical) else "none (implicit)",
        "time step": f"{engineering(step, 's', 6)}, {steps:,} steps to {engineering(step * steps, 's')}",
        "linear solver": "none, nodes are solved independently" if linear is None else linear.why,
    }
    choice = None if linear is None else {"asked": list(asked), "choice": asdict(linear)}
    record = {"step": step, "frequency": list(frequency), "linear": choice}
    return Plan(scheme, AXIS, texts, step, step * steps, linear, steps, critical, frequency, record)


def _highest_frequency(model: Model) -> Frequency:
    """Return bounds on the highest frequency of the model at any time, unstrained. Collective."""
    frequency = highest_frequency(model, model.mesh.points)
    softens = model.temperatures.varying and any(law_of(m).modulus is not None for m in model.case.material.values())
    bars = model.bars
    varying = softens or model.rest_lengths.varying
    if not (varying or bars.slackens):
        return frequency
    kept = bars.rest, bars.heat.copy()
    if model.rest_lengths.varying:
        model.rest_lengths.shorten()
    if softens:
        model.temperatures.stiffen()
    if model.comm.allreduce(bars.tighten(), op=MPI.LOR) or varying:
        other = highest_frequency(model, model.mesh.points)
        frequency = Frequency(min(frequency.lower, other.lower), max(frequency.upper, other.upper))
    bars.rest, bars.heat[:] = kept
    return frequency


def dashpot_rate(model: Model) -> float:
    """Return the largest c/m of dashpots [1/s]; at most three times as large with consistent mass. Collective."""
    inertia = model.inertia
    factor = 3.0 if inertia.consistent else 1.0
    return factor * model.comm.allreduce(float((inertia.points.damping / inertia.mass).max(initial=0.0)), op=MPI.MAX)


def _stable_step(scheme: Scheme, ratio: float, frequency: float, beta: float, viscous: float = 0.0) -> float:
    """Return the stable step [s] at an angular frequency [rad/s] and a damping ratio, with damping C = beta K of bars.

    ``viscous`` is the largest eigenvalue of other damping C over M by rates of strain [1/s], like beta w^2.
    """
    if scheme.explicit:
        frequency = max(frequency, _LEAST * viscous)
    if not frequency > 0.0:
        return np.inf
    return scheme.limit(ratio, 0.5 * (beta * frequency + viscous / frequency)) / frequency


def _check_laws(case: Case, scheme: Scheme) -> None:
    """Refuse material laws that are not compatible with the scheme."""
    for name, material in case.material.items():
        reason = law_of(material).refuses(scheme)
        if reason is not None:
            raise InputError(
                f'{case.source}: material.{name}.law = "{law_name(dict(material))}" is not compatible with '
                f'time.integrator = "{case.time.integrator}": {reason}; use another integrator or law'
            )


def _linear(model: Model, scheme: Scheme, over: float, steps: int) -> LinearChoice:
    """Choose the linear solver for steps of ``over`` times the limit of central differences."""
    from ..solvers.background_grid import fills_block
    from ..solvers.linear import Demand, choose_linear

    case = model.case
    impact = model.can_touch or not all(law_of(material).smooth for material in case.material.values())
    solver, unknowns = case.solver, 3 * model.mesh.n_nodes
    touch = model.self_contact
    operator = solver.operator if touch is None else touch.operator()
    try:
        block = solver.linear == "auto" and fills_block(model.mesh)
        symmetric = scheme.symmetric and (touch is None or touch.symmetric)
        choice = choose_linear(solver.linear, operator, Demand(unknowns, over, symmetric, steps, impact, block))
    except InputError as error:
        raise InputError(f"{case.source}: {error}") from error
    if choice.preconditioner == "multigrid" and (model.links or not model.links.symmetric):
        choice = replace(choice, why=f"{choice.why}; Jacobi where links may close or nodes slip")
    if not model.links.symmetric and choice.krylov == "cg":
        return replace(choice, why=f"{choice.why}; GMRES near walls with friction")
    return choice


def _steps_to(end: float, step: float, source: str) -> int:
    if not end / step < _MOST_STEPS:
        raise InputError(
            f"{source}: time.end = {end:g} s in steps of {step:g} s needs more steps than can be counted; use a larger "
            "time.step or a smaller time.end"
        )
    return max(int(np.ceil(end / step * (1.0 - 1e-12) - 1e-9)), 1)


_DAMPED = 0.2  # largest damping rate times step for an accurate ledger; at the rate 1/s a velocity decays to 1/e in 1 s

TREATMENTS = "pfem_petsc.contact.treatments"


def make_stepper(model: Model, plan: Plan) -> Stepper:
    """Create the stepper of a plan, with the case's treatment of impact. Collective.

    Raises
    ------
    InputError
        On all ranks, if the scheme is not compatible with the treatment.
    """
    treatment = _treatment(model, plan)
    if model.self_contact is not None:
        model.self_contact.begin(plan.scheme, plan.step, plan.frequency.upper, plan.critical_step)
    _check_walls(model, plan, treatment)
    model.warnings += _warnings(model, plan)
    if treatment is not None:
        treatment.prepare(model)
    if plan.linear is not None:
        from .implicit import ImplicitStepper

        stepper: Stepper = ImplicitStepper(model, plan.scheme, plan.step, plan.linear)
    else:
        explicit = ExplicitStepper if model.inertia.redistribution is None else RedistributedStepper
        stepper = explicit(model, plan.scheme, plan.step)
    stepper.plan = plan
    if treatment is not None:
        stepper.treatment = treatment(stepper)
    elif (model.contact.restitution.any() or model.links.rows.rebounds) and not plan.scheme.solves_next_position:
        stepper.treatment = Restitution(stepper)
    return stepper


def _treatment(model: Model, plan: Plan) -> type[Treatment] | None:
    """Return the treatment of the case; None for the formulas of the scheme, and if nothing can touch."""
    name = model.case.contact.treatment
    if name == "scheme" or not model.can_touch:
        return None
    treatment = lookup(TREATMENTS, name, "contact.treatment").Treatment
    key = f'{model.case.source}: contact.treatment = "{name}"'
    if model.inertia.consistent:
        raise InputError(f'{key}: needs time.mass = "lumped"')
    reason = treatment.refuses(plan.scheme)
    if reason is not None:
        raise InputError(f'{key} with time.integrator = "{model.case.time.integrator}": {reason}')
    return treatment


def _warnings(model: Model, plan: Plan) -> Iterator[str]:
    """Give what users should know about damping, drag and contact with this scheme, treatment, mass and step.
    Collective."""
    # where damping stops nodes within a few steps, no rule over steps gives its dissipation accurately
    rate = max(material.damping / material.density for material in model.case.material.values())
    rate = max(model.inertia.largest_factor * rate, dashpot_rate(model))
    if rate * plan.step > _DAMPED:
        yield (
            f"time.step = {plan.step:.4g} s: damping stops nodes within a few steps (material.damping / density, or "
            f"dashpot.coefficient / mass, * step = {rate * plan.step:.2g}), so the recorded damping dissipation has "
            f"an error of this order; use "
            f"a time.step of at most {_DAMPED / rate:.2g} s, or less damping"
        )
    # drag by predicted velocities is stable up to a rate of 2/3 a step
    wind = model.external.wind
    rate = 0.0 if wind is None else wind.rate(wind.fastest())
    if rate * plan.step > _DAMPED:
        yield (
            f"time.step = {plan.step:.4g} s: the drag of [wind] stops bars within a few steps (rho C_d d U / (density "
            f"area) * step = {rate * plan.step:.2g}), which its explicit evaluation does not follow; use a time.step "
            f"of at most {_DAMPED / rate:.2g} s"
        )
    if model.can_touch:
        fastest = plan.frequency.upper / (np.sqrt(3.0) if model.inertia.consistent else 1.0)
        across = 0.5 * fastest * model.length / model.wave_speed
        yield from filter(None, [warn_of_gain(model.case, 0.5 * fastest * plan.step, across)])


def _check_walls(model: Model, plan: Plan, treatment: type[Treatment] | None) -> None:
    """Refuse features of walls that the scheme does not support."""
    walls = model.case.wall
    if any(wall.mass is not None for wall in walls):
        if treatment is not None:
            raise InputError(
                f'{model.case.source}: wall.mass needs contact.treatment = "scheme": other '
                "treatments change velocities by jumps"
            )
        if model.external.gravity_varies and any(wall.gravity for wall in walls):
            raise InputError(
                f"{model.case.source}: gravity.acceleration: walls with gravity = true need a constant gravity, "
                "not rows over time"
            )
        gravity, centres = tuple(model.external.gravity), model.contact.centres
        model.contact.motion.bodies = FreeWalls(walls, plan.scheme, model.comm, gravity, centres)
    explicit = plan.linear is None
    model.links.check(model.case.contact.treatment, explicit, model.size)
    for k, wall in enumerate(walls):
        key = f"{model.case.source}: wall {model.contact.names[k]!r}"
        model.contact.rebounds |= _check_surface(model, plan, treatment, wall, key)
        if wall.tied:
            _check_serves(treatment, "tied", key)
        if wall.restitution and wall.mass is not None and not plan.scheme.solves_next_position:
            # the impulse of a velocity jump does not move walls with mass
            raise InputError(f"{key}: restitution of a wall with mass needs central_differences")
    for pair in model.case.contact_pair:
        key = f"{model.case.source}: contact_pair {pair.name!r}"
        if pair.friction_coefficients[1] and treatment is not None:
            raise InputError(f'{key}: friction needs contact.treatment = "scheme"; use it, or remove friction')
        model.links.rebounds |= _check_surface(model, plan, treatment, pair, key)
        if pair.restitution and not (model.links.rebounds or (model.links.alone and not model.links.dynamic)):
            raise InputError(
                f"{key}: restitution of nodes that are in several pairs or constraints, or that walls stop as well, "
                "needs central_differences"
            )


def _check_surface(model: Model, plan: Plan, treatment: type[Treatment] | None, keys: SurfaceKeys, key: str) -> bool:
    """Refuse friction and restitution that the scheme or treatment does not support; return whether the latter is a
    bound on the next position."""
    scheme, name, rough = plan.scheme, model.case.time.integrator, keys.friction_coefficients[1] > 0.0
    if keys.restitution:
        if model.inertia.consistent:
            raise InputError(f'{key}: restitution needs time.mass = "lumped": one node\'s velocity jumps')
        if not scheme.jumps_known:
            raise InputError(
                f"{key}: restitution with {name}, whose substeps differ, is not known; use another integrator"
            )
        if not scheme.solves_next_position:
            _check_serves(treatment, "restitution", key)
            # the impulse of a velocity jump causes no friction
            if rough:
                raise InputError(f"{key}: restitution together with friction needs central_differences")
        elif treatment is not None:
            raise InputError(f'{key}: with {name} restitution needs contact.treatment = "scheme"')
    if rough:
        _check_serves(treatment, "friction", key)
        if treatment is not None and not scheme.jumps_known:
            raise InputError(
                f'{key}: friction with {name} needs contact.treatment = "scheme": the '
                "friction of velocity jumps is not known for it; use another treatment or integrator"
            )
    return bool(keys.restitution) and scheme.solves_next_position


def _check_serves(treatment: type[Treatment] | None, what: str, key: str) -> None:
    """Refuse a key of walls that the treatment does not support."""
    if treatment is None or what in treatment.serves:
        return
    known = {name: lookup(TREATMENTS, name, "").Treatment for name in choices(TREATMENTS)}
    served = ['"scheme"', *(f'"{name}"' for name, other in known.items() if what in other.serves)]
    raise InputError(f"{key}: {what} needs contact.treatment = {' or '.join(served)}")
