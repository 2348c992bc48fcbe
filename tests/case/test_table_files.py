"""Tables over time from CSV, NPZ and NPY files: columns by name or number, units, refusals; what the case keeps."""

import numpy as np
import pytest

from pfem_petsc import Case
from pfem_petsc.errors import InputError

TIMES = [0.0, 0.25, 1.0]
VALUES = {"a": [0.0, 1.0, -2.0], "b": [3.0, 4.0, 5.0], "c": [0.5, 0.5, 0.0]}


@pytest.fixture(params=["comma", "semicolon", "blank", "tab", "npz", "matrix", "npy"])
def columns(request, tmp_path):
    """A file with the columns t, c, a, b; the name or number of each."""
    order = ["t", "c", "a", "b"]
    data = {"t": TIMES, **VALUES}
    table = np.array([data[name] for name in order]).T
    kind = request.param
    if kind == "npz":
        np.savez(tmp_path / "x.npz", **{name: np.array(data[name]) for name in order}, text=np.array("not a column"))
        return "x.npz", {name: name for name in order}
    if kind == "matrix":
        np.savez(tmp_path / "x.npz", t=table[:, 0], rest=table[:, 1:])
        return "x.npz", {"t": "t", "c": "rest[0]", "a": "rest[1]", "b": 3}
    if kind == "npy":
        np.save(tmp_path / "x.npy", table)
        return "x.npy", {name: k for k, name in enumerate(order)}
    separator = {"comma": ", ", "semicolon": ";", "blank": "  ", "tab": "\t"}[kind]
    heading = separator.join(f'"{name}"' for name in order)
    lines = ["# made by hand", heading, "", *(separator.join(map(repr, row)) for row in table.tolist())]
    (tmp_path / "x.csv").write_text("\n".join(lines))
    return "x.csv", {"t": "t", "c": 1, "a": "a", "b": "b"}


def test_columns_of_every_table(case_text, tmp_path, columns):
    """Loads, temperatures, gravity, supports and walls take columns of a file in the same way."""
    file, named = columns
    motion = [named["t"], named["a"], "", named["b"]]
    data = f'"{file}", columns = {[named["t"], named["b"]]!r}'.replace("'", '"')
    moved = f'{{file = "{file}", columns = {motion!r}, scale = 2.0}}'.replace("'", '"')
    overrides = [
        f"load.0.table_file={{file = {data}, scale = 10.0, offset = -1.0, time_scale = 1e-3, time_offset = 2.0}}",
        "load.0.table=",
        f"temperature=[{{table_file = {{file = {data}}}}}]",
        f"gravity.acceleration_file={moved}",
        "gravity.acceleration=[0.0, -5.0, 0.0]",
        "support.0.fix=xyz",
        f"support.0.acceleration_file={moved}",
        f"wall.0.motion_file={moved}",
    ]
    case = Case.from_toml(case_text, tmp_path, overrides=overrides)
    b = VALUES["b"]
    assert case.load[0].table == tuple((1e-3 * t + 2.0, 10.0 * v - 1.0) for t, v in zip(TIMES, b, strict=True))
    assert case.temperature[0].table == tuple(zip(TIMES, b, strict=True))
    rows = tuple((t, 2.0 * x, 0.0, 2.0 * z) for t, x, z in zip(TIMES, VALUES["a"], b, strict=True))
    assert case.support[0].acceleration == case.wall[0].motion == rows
    assert case.gravity.acceleration == tuple((t, x, -5.0, z) for t, x, _, z in rows)
    assert Case.from_toml(case.to_toml(), "/nowhere") == case  # the resolved case needs no file


DAMAGED = {
    "missing column": ("t,p\n0,1\n", ["t", "q"], "there is no column 'q'; known: t, p"),
    "number beyond": ("0,1\n1,2\n", [0, 2], "column 2 does not exist: the file has the columns 0 to 1"),
    "names without heading": ("0,1\n1,2\n", ["t", "p"], "there is no column 't'; its columns have no names"),
    "a name twice": ("t,p,p\n0,1,2\n", ["t", "p"], "there are 2 columns 'p'"),
    "too few": ("t,p\n0,1\n", ["t"], "expected 2 columns, t, value"),
    "no time": ("t,p\n0,1\n", ["", "p"], "the first column is the time"),
    "all, but too many": (
        "t,p,q\n0,1,2\n",
        None,
        r"line 2: expected two finite numbers t, value, got 3 columns \(t, p, q\)",
    ),
    "empty cell": ("t,p\n0,1\n1,,\n", ["t", "p"], "line 3: expected numbers, got ''"),
    "no number": ("t,p\n0,1\n1,x\n", ["t", "p"], "line 3: expected numbers, got 'x'"),
    "not finite": ("t,p\n0,1\n1,inf\n", ["t", "p"], "line 3: expected two finite numbers"),
    "not increasing": ("t,p\n0,1\n\n0,2\n", ["t", "p"], "line 4: times must increase, but 0.0 follows 0.0"),
    "uneven": (
        "t,p\n0,1\n1\n",
        ["t", "p"],
        "line 3: expected 2 columns as in line 2, got '1'; lines that are not",
    ),
    "words in the first row": ("t,p\n0,x\n1,2\n", ["t", "p"], "line 2: expected numbers, got 'x'"),
    "title, not commented, in the rows": ("t,p\n0,1\nend\n", ["t", "p"], "line 3: expected 2 columns"),
    "decimal commas alone": ("0,0;1,5\n1,0;2,5\n", None, "line 1: expected numbers, got '0,0'"),
    "no rows": ("t,p\n", ["t", "p"], "this file has no rows"),
    "no text": (b"\xff\xfe\x00", None, "this is not a text file"),
    "decimal commas": ("t;p\n0,0;1,5\n", [0, 1], "line 2: expected numbers, got '0,0'"),
}


@pytest.mark.parametrize("title", ["Station: XYZ\n", "Station XYZ, 1995\n\nUnits: s, m\n", ",,\nrecord\n"])
def test_lines_before_the_rows_are_headings(case_text, tmp_path, title):
    (tmp_path / "x.csv").write_text(title + "t (s), u, p\n 0.0, 7, 1.0\n 0.5, 7, 2.0\n")
    given = '{file = "x.csv", columns = ["t (s)", "p"]}'
    case = Case.from_toml(case_text, tmp_path, overrides=["load.0.table=", f"load.0.table_file={given}"])
    assert case.load[0].table == ((0.0, 1.0), (0.5, 2.0))


@pytest.mark.parametrize("text, columns, told", DAMAGED.values(), ids=DAMAGED)
def test_refused_text_files(case_text, tmp_path, text, columns, told):
    (tmp_path / "x.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    chosen = "" if columns is None else f", columns = {columns!r}".replace("'", '"')
    overrides = ["load.0.table=", f'load.0.table_file={{file = "x.csv"{chosen}}}']
    with pytest.raises(InputError, match=r'load\[0\].table_file = "x.csv".*: ' + told):
        Case.from_toml(case_text, tmp_path, overrides=overrides)


def test_refused_arrays(case_text, tmp_path):
    def told(*columns, **arrays):
        np.savez(tmp_path / "x.npz", **arrays)
        overrides = [
            "load.0.table=",
            f'load.0.table_file={{file = "x.npz", columns = {list(columns)!r}}}'.replace("'", '"'),
        ]
        with pytest.raises(InputError) as error:
            Case.from_toml(case_text, tmp_path, overrides=overrides)
        return str(error.value)

    t = np.arange(3.0)
    assert "have [3, 2] rows" in told("t", "p", t=t, p=t[:2])
    assert "row 1: expected two finite numbers" in told("t", "p", t=t, p=np.array([0.0, np.nan, 1.0]))
    assert "row 2: times must increase, but 1.0 follows 1.0" in told("t", "p", t=np.array([0.0, 1.0, 1.0]), p=t)
    assert "no columns of numbers" in told("t", "p", t=np.array(["a"]))
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 cut off")
    overrides = ["load.0.table=", "load.0.table_file=x.npz"]
    with pytest.raises(InputError, match="this file cannot be read"):
        Case.from_toml(case_text, tmp_path, overrides=overrides)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["load.0.table_file=x.csv"], "load[0]: expected at most one of the keys table_file, table"),
        (["load.0.table=", "load.0.table_file=3"], "expected the name of a file, or a table with the key file"),
        (
            ["load.0.table=", 'load.0.table_file={file = "x.csv", colums = ["t"]}'],
            "unknown key, did you mean 'columns'?",
        ),
        (["load.0.table=", "load.0.interpolation=smooth"], 'interpolation = "smooth" requires rows over time'),
        (["temperature=[{value = 1.0, table_file = 'x.csv'}]"], "at most one of the keys table_file, value"),
        (
            ["wall.0.motion_file=x.csv", "wall.0.velocity=[1.0, 0.0, 0.0]"],
            "at most one of the keys motion_file, velocity",
        ),
        (["gravity.acceleration=[0.0, 1.0]", "gravity.acceleration_file=x.csv"], "gravity.acceleration"),
        (["gravity.acceleration=[[0.0, 1.0, 2.0]]"], "gravity.acceleration"),
    ],
)
def test_refused_keys(case_text, tmp_path, overrides, told):
    (tmp_path / "x.csv").write_text("t,p\n0,1\n")
    with pytest.raises(InputError) as error:
        Case.from_toml(case_text, tmp_path, overrides=overrides)
    assert told in str(error.value)
