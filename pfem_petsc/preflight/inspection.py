"""All checks before a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..statics.stability import names_motions
from .forecast import memory_warning
from .geometry import Geometry
from .values import far_points, odd_numbers
from .walls import bars_larger_than_walls, idle_walls, jumping_motions, wall_gaps

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.model import Model
    from ..stepping.plan import Plan


def warnings_before(case: Case, model: Model, plan: Plan) -> list[str]:
    """Return warnings of the cheap checks, which run at every start. Collective."""
    geometry, texts = Geometry(model), odd_numbers(case, model) + memory_warning(case, model, plan)
    texts += wall_gaps(model)[1] + jumping_motions(case, plan) + bars_larger_than_walls(case, model)
    count, nodes, first = geometry.parts()
    if count > 1 and not model.links:  # links connect bodies
        texts.append(
            f"the truss is in {count} parts that no bar connects; the smallest has {nodes} nodes, node {first} among "
            "them"
        )
    pairs, shown = geometry.overlaps() if _is_own(case) else (0, [])
    if pairs:
        texts.append(
            f"{pairs} pair{'s' if pairs > 1 else ''} of bars overlap{'' if pairs > 1 else 's'} from a common node on: "
            f"{_list(pairs, shown)}; if a node is intended to divide the longer one, remove that bar"
        )
    chained, first = geometry.chains() if _is_own(case) else (0, -1)
    if chained:
        nodes = "1 node is" if chained == 1 else f"{chained} nodes are"
        texts.append(
            f"{nodes} only connected to two collinear bars, and nothing supports them laterally; the first is node "
            f"{first}. Was the mesh subdivided? Each member of a truss is one bar: in Gmsh `Transfinite Curve {{:}} = "
            "2;` (an intended chain of bars, such as a cable, needs tension to be stiff)"
        )
    return texts + _loose_nodes(model, geometry, chained)


def warnings_of_stage(case: Case, model: Model, plan: Plan) -> list[str]:
    """Return warnings of the checks whose outcome depends on the tables of a stage, without its source. Collective.

    Positions and velocities at the start of a later stage are not known before, so that gaps to its walls are not
    checked.
    """
    geometry, texts = Geometry(model), odd_numbers(case, model) + memory_warning(case, model, plan)
    texts += idle_walls(model) + jumping_motions(case, plan) + bars_larger_than_walls(case, model)
    texts += _loose_nodes(model, geometry, geometry.chains()[0] if _is_own(case) else 0)
    return [text.removeprefix(f"{case.source}: ") for text in texts]


def inspect(case: Case, model: Model) -> tuple[dict[str, str], list[str]]:
    """Return label and text of further entries of ``check``, and warnings. Collective."""
    geometry, warnings = Geometry(model), []
    count, _, _ = geometry.parts()
    entries = {"parts": "all bars are connected" if count == 1 else f"{count} that no bar connects"}
    rigidity = geometry.rigidity()
    entries |= ({"rigidity": rigidity} if rigidity else {}) | far_points(case, model)
    entries |= {f"wall {name}": text for name, text in wall_gaps(model)[0].items()}
    if not _is_own(case):
        return entries, warnings
    found = geometry.nodes_on_bars()
    if found is None:
        entries["nodes on bars"] = "not checked: bars of too different lengths"
        return entries, warnings
    between, on_bars, coinciding, together = found
    if coinciding:
        pairs = _list(coinciding // 2, together)
        entries["same place"] = f"{coinciding:,} nodes, {pairs}: merge them unless they are on different bodies"
    if between:
        many = "nodes lie on bars that they are not connected to"
        what = many if between > 1 else "node lies on a bar that it is not connected to"
        shown = _list(between, on_bars)
        warnings = [f"{between} {what}: {shown}; if they are intended to be connected, divide the bar there"]
    return entries, warnings


def _is_own(case: Case) -> bool:
    """Whether nodes and bars come from the user: from a file, arrays, or from a unit cell of a lattice.

    Other generated meshes are valid by construction, and their members are not divided.
    """
    return not case.mesh.arranged or getattr(case.mesh.parameters, "cell", None) is not None


def _loose_nodes(model: Model, geometry: Geometry, chained: int) -> list[str]:
    """Warn of nodes that can move freely, besides those within ``chained`` bars. Collective.

    Static analyses that need a stiffness name such nodes and their directions themselves, if it is singular.
    """
    static = model.case.static is not None and model.case.static.method != "relaxation"
    if static and names_motions(model):
        return []
    loose, first = geometry.unbraced()
    if loose <= chained:
        return []
    return [
        f"{loose} node{'s' if loose > 1 else ''} can move freely, to first order: bars and supports hold too few "
        f"directions there; the first is node {first}"
    ]


def _list(count: int, shown: list[str]) -> str:
    return ", ".join(shown) + (", ..." if count > len(shown) else "")
