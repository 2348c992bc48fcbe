"""Axial forces of a truss by PyNite's linear analysis: python run_pynite.py MODEL.json FORCES.json

MODEL has points, bars, areas, young_modulus, fixed nodes and loads [node, force]; FORCES is a list, tension positive.
"""

import json
import sys
from pathlib import Path

from Pynite import FEModel3D

given = json.loads(Path(sys.argv[1]).read_text())
model = FEModel3D()
model.add_material("m", given["young_modulus"], given["young_modulus"] / 2.6, 0.3, 0.0)
for node, point in enumerate(given["points"]):
    model.add_node(f"N{node}", *point)
    model.def_support(f"N{node}", *[node in given["fixed"]] * 3, True, True, True)
for area in sorted(set(given["areas"])):
    model.add_section(f"A{area}", area, 1e-6, 1e-6, 1e-6)
for bar, ((first, last), area) in enumerate(zip(given["bars"], given["areas"], strict=True)):
    model.add_member(f"B{bar}", f"N{first}", f"N{last}", "m", f"A{area}")
    model.def_releases(f"B{bar}", Ryi=True, Rzi=True, Ryj=True, Rzj=True)
for node, force in given["loads"]:
    for axis, value in zip("XYZ", force, strict=True):
        model.add_node_load(f"N{node}", f"F{axis}", value)
model.analyze_linear()
forces = [-float(model.members[f"B{bar}"].axial(0.0, "Combo 1")) for bar in range(len(given["bars"]))]
Path(sys.argv[2]).write_text(json.dumps(forces))
