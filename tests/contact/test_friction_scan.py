"""The table of friction in an impact in docs/contact.md: what it shows, and that it is what the program does."""

import friction_scan as table
import pytest
from pages import DOCS

from pfem_petsc.errors import InputError

TEXT = (DOCS / "contact.md").read_text(encoding="utf-8").split(table.START)[1].split(table.END)[0]
HEAD, _, *ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in TEXT.split("\n\n")[0].splitlines()]


def row_of(integrator, parameters):
    name = table.label(integrator, parameters)
    return dict(zip(HEAD[1:], next(row for row in ROWS if row[0] == name)[1:], strict=True))


def test_stick_is_exact_for_every_scheme():
    assert [row[0] for row in ROWS] == [table.label(*scheme) for scheme in table.SCHEMES]
    for integrator, parameters in table.SCHEMES:
        row = row_of(integrator, parameters)
        assert {cell for column, cell in row.items() if column.startswith("`stick`,")} == {"0"}
        assert {cell for column, cell in row.items() if column.endswith("μ = 0")} <= {
            "0",
            *(f"({k})" for k in range(9)),
        }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "parameters"),
    [("central_differences", {}), ("hulbert_chung", {"rho_b": 0.0}), ("newmark", {"beta": 0.25, "gamma": 0.5})],
)
@pytest.mark.parametrize("kind", ["`scheme`", "`stick`", "`scheme`, wall with mass", "`scheme`, e = 1/2"])
def test_page_has_what_the_program_does(kind, integrator, parameters):
    cell = row_of(integrator, parameters)[f"{kind}, μ = 0.9"]
    treatment, wall = table.KINDS[kind]
    if cell.startswith("("):
        with pytest.raises(InputError) as refused:
            table.error_of(integrator, parameters, treatment, wall | {"friction": 0.9})
        assert f"\n{cell.strip('()')}. {table.reason_of(refused.value)}\n" in TEXT
    else:
        error = table.error_of(integrator, parameters, treatment, wall | {"friction": 0.9})
        assert error == pytest.approx(float(cell), abs=0.0051)
