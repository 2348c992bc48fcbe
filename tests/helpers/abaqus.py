"""An Abaqus input file without parts, as a program would write it."""

from pathlib import Path

MESHES = Path(__file__).parents[2] / "meshes"

FLAT = """*HEADING
 A tripod, written by hand
**
*Node, nset=ALL
1, 0., 0.
10, 1.D+0, 0., 0.
  7,5.0d-1 , 1.0, 0.0,
** a comment between data lines

21, .5, , 1.25E0
*ELEMENT, TYPE=t3d2,
   ELSET=Base
1, 1, 10
2, 10, 7

5, 7, 1
*Element, type=T3D2, elset=LEGS
11, 1, 21
12, 21, 10
20, 7, 21
*NSET, NSET=Top
21,
*NSET, NSET=Feet, GENERATE
1, 10
*NSET, NSET = every one
top, FEET
*NSET, NSET=Top
7
*ELSET, ELSET=some, GENERATE
1, 11, 5
*MATERIAL, NAME=Steel
*ELASTIC, TYPE=ISOTROPIC
210.E9, .3, 20.
205.E9, .3, 100.
*DENSITY
7850.,
*EXPANSION
1.2e-5
*Damping, alpha=2., beta=1.E-5
*SOLID SECTION, ELSET=base, MATERIAL=STEEL
1.D-4,
*SOLID SECTION, ELSET=legs, MATERIAL=steel
2.E-4
*STEP
*CLOAD
21, 3, -1.
*END STEP
"""


def written(folder, text, name="a.inp"):
    (folder / name).write_text(text)
    return folder / name
