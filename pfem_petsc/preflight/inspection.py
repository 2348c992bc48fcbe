"""All that is looked at before a run, in one call."""

from __future__ import annotations

from .forecast import memory_warning
from .parts import count_parts
from .rigidity import global_rigidity, model_directions, unbraced_nodes
from .sanity import odd_numbers
from .walls import wall_gaps

__all__ = ["inspect", "warnings_before"]


def warnings_before(case, model, plan) -> list[str]:
    """What looks wrong and is cheap to find: for every start. Collective."""
    texts = odd_numbers(case, model) + memory_warning(case, model, plan) + wall_gaps(model)[1]
    count, nodes, first = count_parts(model.mesh)
    if count > 1:
        texts.append(
            f"the truss is in {count} parts that no bar connects; the smallest has {nodes} nodes, node {first} among "
            "them"
        )
    loose, first = unbraced_nodes(model)
    if loose:
        texts.append(
            f"{loose} node{'s' if loose > 1 else ''} can move freely, to first order: bars and supports hold too few "
            f"directions there; the first is node {first}"
        )
    return texts


def inspect(case, model) -> dict[str, str]:
    """Label and text of what ``check`` tells besides. Collective."""
    entries = {}
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
    for name, text in wall_gaps(model)[0].items():
        entries[f"wall {name}"] = text
    return entries
