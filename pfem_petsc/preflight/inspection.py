"""All checks before a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..statics.bordered import names_motions
from .chains import chain_nodes, chain_warning
from .forecast import memory_warning
from .motions import jumping_motions
from .nodes_on_bars import nodes_on_bars
from .overlaps import overlapping_bars
from .parts import count_parts
from .reach import bars_larger_than_walls
from .rigidity import global_rigidity, model_directions, unbraced_nodes
from .sanity import far_points, odd_numbers
from .walls import idle_walls, wall_gaps

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model
    from ..stepping.plan import Plan

__all__ = ["inspect", "warnings_before", "warnings_of_stage"]


def warnings_before(case: Case, model: Model, plan: Plan) -> list[str]:
    """Return warnings of the cheap checks, which run at every start. Collective."""
    texts = odd_numbers(case, model) + memory_warning(case, model, plan) + wall_gaps(model)[1]
    texts += jumping_motions(case, plan) + bars_larger_than_walls(case, model)
    count, nodes, first = count_parts(model.mesh)
    if count > 1 and not model.links:  # links connect bodies
        texts.append(
            f"the truss is in {count} parts that no bar connects; the smallest has {nodes} nodes, node {first} among "
            "them"
        )
    # generated meshes are valid by construction
    own = _is_own(case)
    pairs, shown = overlapping_bars(model.mesh) if own else (0, [])
    if pairs:
        texts.append(
            f"{pairs} pair{'s' if pairs > 1 else ''} of bars overlap{'' if pairs > 1 else 's'} from a common node on: "
            f"{_list(pairs, shown)}; if a node is intended to divide the longer one, remove that bar"
        )
    # generated meshes have undivided members
    chained, first_chained = chain_nodes(model) if own else (0, -1)
    if chained:
        texts.append(chain_warning(chained, first_chained))
    return texts + _loose_nodes(model, chained)


def _loose_nodes(model: Model, chained: int) -> list[str]:
    """Warn of nodes that can move freely, besides those within ``chained`` bars. Collective.

    Static analyses that need a stiffness name such nodes and their directions themselves, if it is singular.
    """
    static = model.case.static is not None and model.case.static.method != "relaxation"
    if static and names_motions(model):
        return []
    loose, first = unbraced_nodes(model)
    if loose <= chained:
        return []
    return [
        f"{loose} node{'s' if loose > 1 else ''} can move freely, to first order: bars and supports hold too few "
        f"directions there; the first is node {first}"
    ]


def warnings_of_stage(case: Case, model: Model, plan: Plan) -> list[str]:
    """Return warnings of the checks whose outcome depends on the tables of a stage, without its source. Collective.

    Positions and velocities at the start of a later stage are not known before, so that gaps to its walls are not
    checked.
    """
    texts = odd_numbers(case, model) + memory_warning(case, model, plan) + idle_walls(model)
    texts += jumping_motions(case, plan) + bars_larger_than_walls(case, model)
    chained, _ = chain_nodes(model) if _is_own(case) else (0, -1)
    return [text.removeprefix(f"{case.source}: ") for text in texts + _loose_nodes(model, chained)]


def inspect(case: Case, model: Model) -> tuple[dict[str, str], list[str]]:
    """Return label and text of further entries of ``check``, and warnings. Collective."""
    entries, warnings = {}, []
    count, _, _ = count_parts(model.mesh)
    entries["parts"] = "all bars are connected" if count == 1 else f"{count} that no bar connects"
    dimensions = len(model_directions(model))
    where = {1: " along its line", 2: " in its plane", 3: ""}[dimensions]
    found = global_rigidity(model)
    if found is not None:
        entries["rigidity"] = (
            f"{found.unknowns} free directions{where}, {found.rigid_motions} rigid motions, {found.mechanisms} "
            f"mechanisms, {found.self_stresses} states of self-stress"
        )
        if found.outside:
            entries["rigidity"] += f"; {found.outside} free directions out of it, which no bar resists"
    entries |= far_points(case, model)
    for name, text in wall_gaps(model)[0].items():
        entries[f"wall {name}"] = text
    if _is_own(case):
        warnings += _nodes_on_bars(model.mesh, entries)
    return entries, warnings


def _is_own(case: Case) -> bool:
    """Whether nodes and bars come from the user: from a file, arrays, or from a unit cell of a lattice."""
    return not case.mesh.arranged or getattr(case.mesh.parameters, "cell", None) is not None


def _nodes_on_bars(mesh: DistributedMesh, entries: dict[str, str]) -> list[str]:
    found = nodes_on_bars(mesh)
    if found is None:
        entries["nodes on bars"] = "not checked: bars of too different lengths"
        return []
    if found.coinciding:
        pairs = _list(found.coinciding // 2, found.shown_coinciding)
        entries["same place"] = f"{found.coinciding:,} nodes, {pairs}: merge them unless they are on different bodies"
    if not found.between:
        return []
    many = "nodes lie on bars that they are not connected to"
    what = many if found.between > 1 else "node lies on a bar that it is not connected to"
    shown = _list(found.between, found.shown_between)
    return [f"{found.between} {what}: {shown}; if they are intended to be connected, divide the bar there"]


def _list(count: int, shown: list[str]) -> str:
    return ", ".join(shown) + (", ..." if count > len(shown) else "")
