"""Every invalid key or value is refused with the file, the key path, the value and what is expected."""

import pytest

from pfem_petsc.case.schema import Case
from pfem_petsc.errors import InputError

SI = "expected a number in SI units, without quotes and unit"

# What is set, and what the message says besides the file.
REFUSED = {
    "unit in a number": (["material.steel.young_modulus=210 GPa"], ['material.steel.young_modulus = "210 GPa"', SI]),
    "number as text": (['mesh.length="1.0"'], ['mesh.length = "1.0"', SI]),
    "text in a vector": (
        ['wall.0.normal=[1.0, "0", 0.0]'],
        ['wall[0].normal[1] = "0"', SI],
    ),
    "text for a vector": (['wall.0.point="10 mm"'], ['wall[0].point = "10 mm"', "list of 3 numbers", "SI units"]),
    "short vector": (["wall.0.normal=[1.0, 0.0]"], ["wall[0].normal = [1.0, 0.0]", "3 numbers, got 2"]),
    "long vector": (["wall.0.normal=[1.0, 0.0, 0.0, 0.0]"], ["wall[0].normal", "3 numbers, got 4"]),
    "number for a vector": (["wall.0.normal=1.0"], ["wall[0].normal = 1.0", "list of 3 numbers"]),
    "zero normal": (["wall.0.normal=[0.0, 0.0, 0.0]"], ["wall[0].normal = [0.0, 0.0, 0.0]"]),
    "boolean for a number": (["time.end=true"], ["time.end = true", "expected a number"]),
    "fraction for an integer": (["mesh.elements=4.5"], ["mesh.elements = 4.5", "expected an integer"]),
    "float for an integer": (["mesh.elements=4.0"], ["mesh.elements = 4.0", "expected an integer"]),
    "too large an integer": (["solver.max_newton=9223372036854775808"], ["solver.max_newton", "< 9.22337e+18"]),
    "integer beyond floats": ([f"time.end=1{'0' * 400}"], ["time.end", "fits in double precision"]),
    "integer beyond floats for a step": ([f"time.step=1{'0' * 400}"], ["time.step", "finite number of seconds"]),
    "integer beyond floats for a prestress": (
        [f"section.strut.prestress=1{'0' * 400}"],
        ["section.strut.prestress", "fits in double precision"],
    ),
    "no rows of a prestress": (["section.strut.pretension=[]"], ["section.strut.pretension = []", "rows [t, force]"]),
    "thickness whose square overflows": (
        ["section.strut.shape=tube", "section.strut.thickness=1e300"],
        ["section.strut", "thickness = 1e+300 m is too much"],
    ),
    "number for a table": (["material.steel.rupture=3"], ["material.steel.rupture = 3", "expected a table"]),
    "infinite": (["time.end=inf"], ["time.end = inf", "finite number"]),
    "not a number": (["mesh.length=nan"], ["mesh.length = nan", "finite number"]),
    "negative area": (["section.strut.area=-1.0"], ["section.strut.area = -1.0", "> 0", "[m2]"]),
    "no mass": (["material.steel.density=0.0"], ["material.steel.density = 0.0", "> 0", "[kg/m3]"]),
    "no strength": (["material.steel.yield_stress=0.0"], ["material.steel.yield_stress = 0.0", "> 0"]),
    "hardening alone": (["material.steel.kinematic_hardening=1e9"], ["kinematic_hardening", "needs a yield_stress"]),
    "softening": (["material.steel.isotropic_hardening=-1e9"], ["isotropic_hardening = -1000000000.0", ">= 0"]),
    "unknown strain": (["material.steel.strain=grean"], ["material.steel.strain", "did you mean 'green'?"]),
    "unknown key": (["material.steel.young_modulu=1.0"], ["young_modulu", "did you mean 'young_modulus'?"]),
    "unknown table": (["materials.steel.density=1.0"], ["materials", "did you mean 'material'?"]),
    "what is not there yet": (["self_contact.radii=3"], ["self_contact", "unknown key"]),
    "unknown generator": (["mesh.generator=rodd"], ['mesh.generator = "rodd"', "did you mean 'rod'?"]),
    "unknown generator key": (
        ["mesh.lenght=1.0"],
        ["mesh.lenght", "generator rod takes length, elements", "'length'?"],
    ),
    "generator and file": (["mesh.file=a.msh"], ["mesh", "exactly one of the keys generator, file"]),
    "unknown integrator": (["time.integrator=newmrk"], ["time.integrator", '"newmrk"', "did you mean 'newmark'?"]),
    "other scheme's key": (
        ["time.beta=0.5"],
        ["time.beta", "a key of chung_lee, newmark, not of central_differences, which takes no parameters"],
    ),
    "other scheme's key where one is like it": (
        ["time.integrator=wilson", "time.beta=0.5"],
        ["time.beta", "a key of chung_lee, newmark, not of wilson, which takes theta"],
    ),
    "other wall's key": (["wall.0.radius=1.0"], ["wall[0].radius", "a key of cylinder, sphere, not of a wall of type"]),
    "other generator's key": (["mesh.cells=[1,1,1]"], ["mesh.cells", "a key of lattice", "not of generator rod"]),
    "misspelt scheme key": (
        ["time.integrator=newmark", "time.betta=0.5"],
        ["time.betta", "newmark takes beta, gamma", "did you mean 'beta'?"],
    ),
    "text for a scheme key": (["time.integrator=newmark", "time.beta=x"], ['time.beta = "x"', SI]),
    "misspelt time key": (["time.stepp=1.0"], ["time.stepp", "did you mean 'step'?"]),
    "step of zero": (["time.step=0.0"], ["time.step = 0.0", "> 0"]),
    "step as text": (["time.step=automatic"], ['time.step = "automatic"', 'or "auto"']),
    "step as boolean": (["time.step=true"], ["time.step = true", 'or "auto"']),
    "infinite step": (["time.step=inf"], ["time.step = inf", "finite"]),
    "implicit scheme without step": (
        ["time.integrator=newmark", "time.step=auto"],
        ["time.step", "newmark is implicit"],
    ),
    "end of zero": (["time.end=0"], ["time.end = 0", "> 0"]),
    "safety above one": (["time.safety=1.5"], ["time.safety = 1.5", "<= 1"]),
    "unknown mass": (["time.mass=lump"], ["time.mass", "lumped"]),
    "unknown wall": (["wall.0.type=plan"], ["wall[0].type", "did you mean 'plane'?"]),
    "wall without type": (["wall.0={point = [1.1, 0.0, 0.0]}"], ["wall[0].type", "missing"]),
    "unknown wall key": (["wall.0.norml=1"], ["wall[0].norml", "a wall of type plane takes", "'normal'?"]),
    "wall's name twice": (
        ["wall.1={name = 'stop', type = 'plane', point = [2.0, 0.0, 0.0], normal = [-1.0, 0.0, 0.0]}"],
        ['wall[1].name = "stop"', "another wall has this name"],
    ),
    "wall's name with slash": (["wall.0.name=a/b"], ['wall[0].name = "a/b"', "without slashes"]),
    "wall's name a number": (["wall.0.name=3"], ["wall[0].name = 3", "text in quotes", "``wall2``, ...)"]),
    "digest": (
        ["load.0={file = 'forces.csv', digest = 'abc'}"],
        ['load[0].digest = "abc"', "expected 64 hexadecimal digits", "without this key any file is accepted"],
    ),
    "wall of unknown nodes": (["wall.0.node_set=tp"], ['wall[0].node_set = "tp"', "did you mean 'tip'?"]),
    "load on unknown nodes": (["load.0.node_set=tp"], ['load[0].node_set = "tp"', "did you mean 'tip'?"]),
    "support of unknown nodes": (["support.0.node_set=bas"], ["support[0].node_set", "did you mean 'base'?"]),
    "probe of unknown nodes": (["output.probe.0.node_set=tp"], ["output.probe[0].node_set", "did you mean 'tip'?"]),
    "start of unknown nodes": (
        ["initial.on.0={node_set = 'tp', velocity = [1.0, 0.0, 0.0]}"],
        ["initial.on[0].node_set", "did you mean 'tip'?"],
    ),
    "start of no nodes": (["initial.on.0.velocity=[1.0, 0.0, 0.0]"], ["initial.on[0].node_set", "missing"]),
    "node set outside initial.on": (["initial.node_set=tip"], ["initial.node_set", "[[initial.on]]"]),
    "centre without rotation": (["initial.centre=[0.0, 0.0, 0.0]"], ["initial", "angular_velocity"]),
    "probe twice": (
        ["output.probe.1={name = 'tip', node_set = 'base'}"],
        ["output.probe[1].name", "another probe has this name"],
    ),
    "unknown material": (["section.strut.material=steal"], ["section.strut.material", "did you mean 'steel'?"]),
    "two default sections": (
        ["section.other={area = 1.0, material = 'steel'}"],
        ["section.other", "strut", "only one can be the default"],
    ),
    "bars of two sections": (
        ["section.a={area = 1.0, material = 'steel', bars = 'g'}", "section.b={area=1.0, material='steel', bars='g'}"],
        ["section.b.bars", "section a has these bars already"],
    ),
    "unknown field": (['output.fields=["velocty"]'], ["output.fields[0]", "did you mean 'velocity'?"]),
    "field twice": (['output.fields=["strain", "strain"]'], ["output.fields[1]", "twice"]),
    "fields as text": (["output.fields=strain"], ["output.fields", "list of texts"]),
    "unknown precision": (["output.precision=float16"], ["output.precision", "float"]),
    "history never": (["output.history_every=0"], ["output.history_every = 0", "> 0"]),
    "negative interval": (["output.fields_every=-1"], ["output.fields_every = -1", ">= 0"]),
    "unknown solver": (["solver.linear=cgg"], ["solver.linear", "did you mean 'cg'?"]),
    "no tolerance": (["solver.rtol=0.0"], ["solver.rtol", "> 0"]),
    "table going back": (
        ["load.0.table=[[0.0, 0.0], [1.0, 1.0], [0.5, 1.0]]"],
        ["load[0].table", "times must increase, but row 2 has t = 0.5 after 1.0"],
    ),
    "table standing still": (["load.0.table=[[0.0, 0.0], [0.0, 1.0]]"], ["load[0].table", "times must increase"]),
    "empty table": (["load.0.table=[]"], ["load[0].table", "at least one row"]),
    "table row too short": (["load.0.table=[[0.0]]"], ["load[0].table[0]", "got 1 value"]),
    "temperature of both kinds": (
        ["temperature.0={value = 1.0, table = [[0.0, 1.0]]}"],
        ["temperature[0]", "exactly one of the keys value, table"],
    ),
    "fixed axis unknown": (["support.0.fix=xw"], ['support[0].fix = "xw"', "x, y, z"]),
    "fixed axis twice": (["support.0.fix=xx"], ['support[0].fix = "xx"', "each once"]),
    "moved but free": (["support.0.velocity=[1.0, 0.0, 0.0]"], ["support[0]", 'x is given a motion, but fix = "yz"']),
    "moved twice": (
        ["support.0.velocity=[0.0, 1.0, 0.0]", "support.0.motion=[[0.0, 0.0, 1.0, 0.0]]"],
        ["support[0]", "at most one of the keys motion, velocity"],
    ),
    "moved and shaken": (
        ["support.0.velocity=[0.0, 1.0, 0.0]", "support.0.acceleration=[[0.0, 0.0, 1.0, 0.0]]"],
        ["support[0]", "at most one of the keys motion, velocity, acceleration"],
    ),
    "moved and shaken from a file": (
        ["support.0.velocity=[0.0, 1.0, 0.0]", "support.0.acceleration_file=a.csv"],
        ["support[0]", "at most one of the keys acceleration_file, velocity"],
    ),
    "shaken but free": (
        ["support.0.acceleration=[[0.0, 1.0, 0.0, 0.0]]"],
        ["support[0]", 'x is given a motion, but fix = "yz"'],
    ),
    "record that is not there": (
        ["support.0.acceleration_file=none.csv"],
        ['support[0].acceleration_file = "none.csv"', "there is no file none.csv in"],
    ),
    "unknown interpolation": (["support.0.interpolation=smoth"], ["support[0].interpolation", "'smooth'?"]),
    "lines of accelerations": (
        ["support.0.acceleration=[[0.0, 0.0, 1.0, 0.0]]", "support.0.interpolation=linear"],
        ["support[0]", "requires motion"],
    ),
    "two choices of nodes": (["node_set.tip.all=true"], ["node_set.tip", "exactly one", "got nearest and all"]),
    "no choice of nodes": (["node_set.tip={}"], ["node_set.tip", "exactly one", "got none"]),
    "not all nodes": (["node_set.tip={all = false}"], ["node_set.tip.all = false", "true"]),
    "corners swapped": (
        ["node_set.tip={box = [[0.0, 1.0, 0.0], [1.0, 0.5, 1.0]]}"],
        ["node_set.tip.box", "y is 1.0 and then 0.5"],
    ),
    "negative node": (["node_set.base.indices=[-1]"], ["node_set.base.indices[0] = -1", ">= 0"]),
    "node twice": (["node_set.base.indices=[1, 1]"], ["node_set.base.indices", "twice"]),
    "table that is a number": (["gravity=9.81"], ["gravity = 9.81", "expected a table"]),
    "list that is a table": (["wall={type = 'plane'}"], ["wall", "[[wall]]"]),
    "title that is a number": (["title=3"], ["title = 3", "text in quotes"]),
}


@pytest.mark.parametrize(("overrides", "words"), REFUSED.values(), ids=REFUSED.keys())
def test_wrong_value(case_file, overrides, words):
    with pytest.raises(InputError) as refused:
        Case.load(case_file, overrides)
    message = str(refused.value)
    assert message.startswith(f"{case_file}: ")
    assert len(message.splitlines()) == 1
    for word in words:
        assert word in message


@pytest.mark.parametrize("table", ["mesh", "time", "material", "section"])
def test_missing_table(case_text, table):
    keep = [block for block in case_text.split("\n\n") if not block.startswith(f"[{table}")]
    with pytest.raises(InputError, match=rf"case: .*\[{table}"):
        Case.from_toml("\n\n".join(keep))


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("density = 7850.0\n", "material.steel.density"),
        ("end = 1e-3\n", "time.end"),
        ("length = 1.0\n", "mesh.length"),
        ("normal = [-1.0, 0.0, 0.0]\n", "wall[0].normal"),
    ],
)
def test_missing_key(case_text, line, key):
    with pytest.raises(InputError) as refused:
        Case.from_toml(case_text.replace(line, ""), source="a.toml")
    assert str(refused.value).startswith(f"a.toml: {key}: this key is missing")


def test_problems_are_reported_together(case_file):
    overrides = ["time.end=0", "mesh.length=x", "section.strut.material=steal", "solver.lineer=cg"]
    with pytest.raises(InputError) as refused:
        Case.load(case_file, overrides)
    lines = str(refused.value).splitlines()
    assert len(lines) == 4
    assert all(line.startswith(f"{case_file}: ") for line in lines)
    for key in ("time.end", "mesh.length", "section.strut.material", "solver.lineer"):
        assert sum(key in line for line in lines) == 1


def test_many_problems_are_counted(case_file):
    with pytest.raises(InputError) as refused:
        Case.load(case_file, [f"solver.wrong{k}=1" for k in range(25)])
    lines = str(refused.value).splitlines()
    assert len(lines) == 11
    assert lines[-1].endswith("and 15 more")


def test_refused_table_is_not_missed_again(case_file):
    """A node set that is there but wrong is one problem, not one for each of its uses."""
    with pytest.raises(InputError) as refused:
        Case.load(case_file, ["node_set.tip.nearest=[1.0, 2.0]"])
    assert len(str(refused.value).splitlines()) == 1


def test_message_tells_what_the_command_line_set(case_file):
    with pytest.raises(InputError, match=r"time\.end = -1 \(given by --set\)"):
        Case.load(case_file, ["time.end=-1"])
    with pytest.raises(InputError, match=r"--set makes a new table material\.steal, the case has steel$"):
        Case.load(case_file, ["material.steal.density=1.0"])
    case_file.write_text(case_file.read_text().replace("end = 1e-3", "end = -1"))
    with pytest.raises(InputError, match=r"time\.end = -1: "):
        Case.load(case_file)
