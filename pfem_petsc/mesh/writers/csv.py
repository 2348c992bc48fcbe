"""A pair of text tables (NAME_nodes.csv, NAME_bars.csv) with groups and bar fields as columns."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ..readers.csv import pair
from ..whole import WholeMesh

__all__ = ["SUFFIXES", "write"]

SUFFIXES = (".csv",)


def write(path: Path, mesh: WholeMesh) -> None:
    """Write both tables, to the last digit; groups without members are not in them."""
    of_nodes, of_bars = pair(path)
    _table(of_nodes, "node", {axis: mesh.points[:, i] for i, axis in enumerate("xyz")}, mesh.node_groups)
    columns = {"first": mesh.bars[:, 0], "second": mesh.bars[:, 1], **mesh.bar_fields}
    _table(of_bars, "bar", columns, mesh.bar_groups)


def _table(path: Path, number: str, columns: dict[str, np.ndarray], groups: dict[str, np.ndarray]) -> None:
    n = len(next(iter(columns.values())))
    texts = [""] * n
    for group, members in groups.items():
        name = group.replace(";", "_")
        for i in members.tolist():
            texts[i] += f";{name}" if texts[i] else name
    lists = [range(n), *(values.tolist() for values in columns.values()), *([texts] if groups else [])]
    with open(path, "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow([number, *columns, *(["groups"] if groups else [])])
        table.writerows(zip(*lists, strict=True))
