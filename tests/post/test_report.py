"""The report of a run is one file that has what the run has, and refers to nothing else."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser

import pytest
from PIL import Image

from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.post.render import Film
from pfem_petsc.post.report import write_report


class Balanced(HTMLParser):
    """Fails where tags are not closed in order."""

    VOID = ("meta", "img")

    def __init__(self):
        super().__init__()
        self.open, self.texts, self.sources = [], [], []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.sources += [values[key] for key in ("src", "href") if key in values]
        if tag == "img":
            assert values["alt"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "rod"
    sets = ["time.end=0.5", "title=A <b>short</b> run & more", "output.fields_every=25"]
    assert main(["rod_impact", "-o", str(folder), "--quiet", "--set", *sets]) == 0
    return folder


@pytest.mark.slow
def test_class_that_the_rows_cannot_carry_has_status_2(run, capsys):
    """100 rows per second carry CFC 10, not CFC 11."""
    assert main(["plot", str(run), "--curves", "wall/wall/force.x", "--filter", "cfc:10"]) == 0
    assert main(["plot", str(run), "--curves", "wall/wall/force.x", "--filter", "cfc:11"]) == 2
    assert "CFC 11 needs 110 rows of the history per second, and this one has 100 where" in capsys.readouterr().err


@pytest.mark.slow
def test_report_of_a_run(run, capsys):
    with (run / "log.txt").open("a") as log:
        log.write("2026-01-01 00:00:00 WARNING something <odd>\n  on two lines\n2026-01-01 00:00:01 INFO    later\n")
    assert main(["report", str(run), "--no-pictures", "--filter", "cfc:6"]) == 0
    assert capsys.readouterr().out.strip() == str(run / "report.html")
    text = (run / "report.html").read_text()
    page = Balanced()
    page.feed(text)
    assert page.open == []
    shown = " ".join(page.texts)
    for expected in (
        "A <b>short</b> run & more",
        "21 nodes, 20 bars",
        "central_differences, lumped mass, to 500.0 ms",
        "518.8 mN (mean over 100 ms) at t = 260.0 ms",
        "impulse of first touches",
        "something <odd>\n  on two lines",
        "No pictures of the truss: not asked for",
        "50 steps in",
        'integrator = "central_differences"',
        "balance error",
    ):
        assert expected in shown, expected
    assert "later" not in shown
    pictures = [source for source in page.sources if source.startswith("data:image/png;base64,")]
    assert len(pictures) == 5 and all(base64.b64decode(p.partition(",")[2])[1:4] == b"PNG" for p in pictures)
    links = [source for source in page.sources if source not in pictures]
    assert links and all(link.startswith("#") and f'id="{link[1:]}"' in text for link in links)
    assert not re.search(r"https?://|url\(", text)


@pytest.mark.slow
def test_report_draws_only_the_picture_that_it_shows(run, tmp_path, monkeypatch):
    monkeypatch.setattr(Film, "frame", None)
    text = write_report(run, tmp_path / "report.html").read_text()
    data = re.findall(r'alt="Instants[^"]*" src="data:image/png;base64,([^"]+)"', text)
    (picture,) = (Image.open(io.BytesIO(base64.b64decode(each))) for each in data)
    assert picture.size == (1600, 900)


@pytest.mark.slow
def test_reports_that_cannot_be_written_are_refused(run, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a folder; name a file"):
        write_report(run, tmp_path, pictures=False)
    assert main(["report", str(run), "--no-pictures", "-o", str(tmp_path / "file" / "r.html")]) == 2
    assert "the report cannot be written" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "nothing")]) == 2
    assert "there is no such result file" in capsys.readouterr().err
