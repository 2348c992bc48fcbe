"""Pictures for papers: exact colours, scales that are told, supports and loads, curves beside the truss."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pictures import camera_of, draw, near, picture_of, pixels, projected
from helpers.synthetic import SyntheticResult, ring
from matplotlib.colors import to_rgb

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError
from pfem_petsc.output.table import Table
from pfem_petsc.output.units import POINT
from pfem_petsc.post.members import draw_members
from pfem_petsc.post.motion import Actions, Motion
from pfem_petsc.post.page import ColourScale, Page
from pfem_petsc.post.render import Film, Options, instants
from pfem_petsc.post.scene import Style, cameras


@pytest.fixture
def flying(tmp_path):
    return SyntheticResult(tmp_path / "x" / "result.vtkhdf", *ring(), walls=())


BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


@pytest.mark.parametrize("view", ["xy", (0.3, 0.2, 1.0)], ids=["parallel", "perspective"])
@pytest.mark.parametrize("count", [1, 2001], ids=["few", "some"])
def test_bars_have_the_colours_of_the_scale_wherever_they_are(view, count):
    """Three bars, near, far and inclined to the view: three quarters of their pixels have the very colour."""
    colours = [(30, 90, 200), (200, 60, 40), (90, 160, 70)]
    points = np.array(
        [[-0.8, 0.6, 0.9], [0.8, 0.6, 0.9], [-0.8, 0.0, -0.9], [0.8, 0.0, -0.9], [-0.8, -0.6, -0.4], [0.8, -0.6, 0.4]]
    )
    bars = np.repeat([[0, 1], [2, 3], [4, 5]], count, axis=0)
    camera, style = camera_of(BOX, view), Style(np.full(len(bars), 0.1), nodes=False)
    picture = picture_of(points, bars, np.repeat(colours, count, axis=0), camera, (300, 300), style)
    x, y, _ = projected(camera, points.reshape(3, 2, 3).mean(axis=1), (300, 300))
    for column, row, colour in zip(x.round().astype(int), y.round().astype(int), colours, strict=True):
        assert picture[row, column].tolist() == list(colour)
        dyed = (picture[:, column - 5 : column + 5] != 255).any(axis=2)
        same = near(picture[row - 8 : row + 8, column - 5 : column + 5], colour, 2)
        assert len(same[0]) > 40 and dyed.any()


def test_rims_leave_thin_bars_their_colour():
    """A bar four pixels wide: its darkest pixel across is at least 70 % of its colour, and crossing bars have edges."""
    points, style = np.array([[-0.8, 0.0, 0.0], [0.8, 0.0, 0.0]]), Style(bar_width=4.0, nodes=False)
    picture = picture_of(points, [[0, 1]], [(200, 100, 100)], camera_of(BOX, "xy"), (300, 300), style)
    across = picture[140:160, 150, 0]
    assert (across == 200).any()
    assert across.min() >= 140


@pytest.mark.parametrize("limits", [(-2.0, 2.0), (-1.0, 3.0), (-5.0, 0.0), (0.0, 4.0)])
def test_zero_is_light_and_equal_magnitudes_are_equally_strong(limits):
    """Zero is grey, everything else darker, the more so the larger; one magnitude has one colour on each side."""
    scale = ColourScale(limits)
    (zero,) = scale.colours(np.zeros(1)).astype(int)
    assert np.ptp(zero) < 16 and zero.min() > 170
    largest = max(map(abs, limits))
    for end in (value for value in limits if value):
        values = np.linspace(0.0, end, 9)
        light = scale.colours(values) @ [0.299, 0.587, 0.114]
        assert (np.diff(light) < 0.0).all()
        same = ColourScale((-largest, largest) if limits[0] < 0.0 else limits).colours(values[-1:])
        assert np.abs(scale.colours(values[-1:]).astype(int) - same).max() <= 2


def foot(file) -> np.ndarray:
    picture = pixels(file)
    return picture[-round(0.06 * len(picture)) :, : picture.shape[1] // 2]


def test_what_is_not_true_to_scale_says_so(tmp_path, flying):
    for options, notes in (
        ({}, []),
        ({"scale": 20.0}, ["displacements × 20"]),
        ({"scale": 0.5}, ["displacements × 0.5"]),
    ):
        assert Film([flying], Options(**options), print).notes == notes
    both = Film([flying, flying], Options(scale=2.0, labels=["one", "other"]), print)
    both.motions[1].actions = SimpleNamespace(notes=["symbols at 3 of 50 loaded nodes"])
    assert both.notes == ["displacements × 2", "other: symbols at 3 of 50 loaded nodes"]
    plain, poster = draw(tmp_path / "a", flying, frames=[0], poster=True, size=(640, 360))
    scaled, larger = draw(tmp_path / "b", flying, frames=[0], poster=True, size=(640, 360), scale=1.5)
    for without, told in ((plain, scaled), (poster, larger)):
        assert pixels(told).shape == (360, 640, 4)  # posters too
        assert (foot(told)[..., 0] < 128).sum() > (foot(without)[..., 0] < 128).sum() + 60
    modes = SimpleNamespace(untrue=lambda scale: f"as {scale:g}")
    motion = Motion(flying, [0], Options(scale=2.0), print)
    motion.result = modes
    assert motion.notes == ["as 2"]


@pytest.mark.parametrize("view", ["xy", "iso"], ids=["parallel", "perspective"])
def test_length_scale_is_that_at_mid_depth(tmp_path, flying, view):
    """The line at the foot is 1, 2 or 5 times a power of ten at the distance of the middle of the picture."""
    options = {"frames": [0], "size": (1280, 720), "view": view}
    line = near(foot(draw(tmp_path, flying, **options)[0]), np.multiply(to_rgb("#5b6472"), 255), 30)
    length = np.bincount(line[0]).argmax()
    columns = line[1][line[0] == length]
    run = columns[: np.flatnonzero(np.diff(columns, append=10_000) > 1)[0] + 1]
    film = Film([flying], Options(**options), print)
    (camera,) = cameras(film.options, film.motions[0], np.divide(*Page.region_of((1280, 720))[2:]))
    x, _, _ = projected(
        camera, camera.centre + np.outer([0.0, 1.0], camera.right), (1110, Page.region_of((1280, 720))[3])
    )
    metres = np.ptp(run) / np.ptp(x)
    assert min(abs(metres / (10.0 ** np.floor(np.log10(metres) + 0.02)) / k - 1.0) for k in (1, 2, 5)) < 0.02


def test_curves_are_below_what_is_drawn(flying):
    """Never over the drawings, and not in tiles that are too small."""
    with pytest.raises(InputError, match="inset needs tiles of 28 x 34 pixels or more, and these have 34 x 31"):
        Film([flying] * 12, Options(inset="kinetic_energy", size=(160, 120)), print).start((160, 120))
    for points in (np.array([1.0, 0.2, 1.0]), np.array([0.2, 1.0, 1.0])):
        result = SyntheticResult("x/result.vtkhdf", ring()[0] * points, ring()[1], walls=())
        for results in ([result], [result, flying]):
            film = Film(results, Options(inset="kinetic_energy", size=(960, 540)), print)
            film.start((960, 540))
            film.frame(0)
            boxes = [tile.bbox for tile in film._page.tiles]
            curves = [tile.child_axes[0].get_tightbbox() for tile in film._page.tiles]
            for k, curve in enumerate(curves):
                others = [*boxes, *curves[:k]]
                assert not any(
                    curve.overlaps(other)
                    and min(curve.x1, other.x1) - max(curve.x0, other.x0) > 1
                    and min(curve.y1, other.y1) - max(curve.y0, other.y0) > 1
                    for other in others
                )
            film.close()


def test_points_of_a_path_are_told_with_their_load_factor(flying):
    flying.axis, flying.times = POINT, np.arange(13.0)
    flying.positions = lambda i: flying.start
    flying.history = {"time": np.arange(13.0), "load_factor": -0.0123456 * np.arange(13)}
    assert Motion(flying, [3], Options(), print).time(3) == "point 3, load factor -0.03704"


CASE = {
    "mesh": {
        "generator": "arrays",
        "points": [[0.0, 0, 0], [2, 0, 0], [1, 0, 1], [1, 1, 0]],
        "bars": [[0, 1], [0, 2], [1, 2], [3, 2]],
    },
    "node_set": {
        "left": {"indices": [0]},
        "right": {"indices": [1]},
        "head": {"indices": [2]},
        "back": {"indices": [3]},
    },
    "material": {"m": {"young_modulus": 1e9, "density": 1e3}},
    "section": {"s": {"area": 1e-4, "material": "m"}},
    "support": [
        {"node_set": "left", "fix": "xyz"},
        {"node_set": "right", "fix": "yz"},
        {"node_set": "back", "fix": "xyz"},
    ],
    "load": [{"node_set": "head", "force": [0.0, 0.0, -100.0]}],
    "gravity": {"acceleration": [0.0, 0.0, -10.0]},
    "static": {"step": 0.5},
    "output": {"fields_every": 1},
    "load_case": [
        {"name": "push", "load": [{"node_set": "head", "force": [40.0, 0.0, 0.0]}]},
        {"name": "pull", "load": [{"node_set": "right", "force": [0.0, 0.0, 30.0]}]},
    ],
    "combination": [{"name": "both", "factors": {"push": 2.0, "pull": 1.0}}],
}


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loads") / "result"
    with Simulation(Case.from_dict(CASE), output=folder, quiet=True) as simulation:
        simulation.run()
    return folder


def test_loads_are_those_of_the_load_case_at_its_load_factor(loaded):
    """Permanent loads by their load factor, then in full; those of load cases by theirs."""
    with open_result(loaded) as result:
        bounds = np.array([[0.0, 0, 0], [2, 1, 1]])
        actions = Actions(result, ["loads"], result.times, bounds)
        head = {"permanent": (0.0, -100.0), "push": (40.0, -100.0), "pull": (0.0, -100.0), "both": (80.0, -100.0)}
        # the longest arrow is that of the largest load of the load case
        largest = {"permanent": 100.0, "push": np.hypot(40, 100), "pull": 100.0, "both": np.hypot(80, 100)}
        assert actions.notes == []
        assert list(actions.everywhere(2)) == ["g"] and actions.everywhere(2)["g"].tolist() == [0, 0, -1]
        told = [result.place(time) for time in result.times]
        for number, text in enumerate(told):
            name, _, factor = text.partition(", load factor ")
            share = float(factor)
            side, down = (part * share for part in (head[name][0], 1.0))
            down = -100.0 * (share if name == "permanent" else 1.0)
            tails, tips = actions.arrows(number, result.positions(number))
            assert actions.longest(number) == f"longest arrow {largest[name]:.0f} N"
            ways = {
                tuple(np.round((tip - tail) * largest[name] / 0.14 / np.sqrt(6.0), 6)) for tail, tip in zip(tails, tips)
            }
            expected = {(side, 0.0, down)} if down else set()
            expected |= {(0.0, 0.0, 30.0 * share)} if name in ("pull", "both") and share else set()
            assert ways == expected, text
            nodes = result.positions(number)
            assert all(np.linalg.norm(nodes - tip, axis=1).min() < 1e-12 for tip in tips)
        assert instants(result, list(range(len(told))), 6) == [
            k for k, text in enumerate(told) if text[:4] in ("push", "pull", "both") and text.endswith(" 1")
        ]


def test_drawings_tell_their_own_loads(loaded):
    """Of several drawings each has its longest arrow and its gravity; of one, both are outside."""
    with open_result(loaded) as result:
        film = Film([result], Options(show=["loads"], size=(640, 360)), print)
        film.poster()
        told = [[text.get_text() for text in tile.texts] for tile in film._page.tiles]
        assert told == [["longest arrow 108 N", "g"], ["longest arrow 100 N", "g"], ["longest arrow 128 N", "g"]]
        film.start(film.options.size)
        film.frame(film.count - 1)
        assert [len(tile.texts) for tile in film._page.tiles] == [0]
        assert {text.get_text() for text in film._page._triad.texts} == {"x", "y", "z", "g"}
        assert film._page._foot.get_text() == "longest arrow 128 N"
        film.close()


def test_supports_have_symbols_of_what_they_hold(loaded, tmp_path):
    """Along y, a node held along x and z has one triangle with strokes, one held along z a triangle with a line."""
    with open_result(loaded) as result:
        actions = Actions(result, ["supports"], result.times[-1:], np.array([[0.0, 0, 0], [2, 1, 1]]))
        flat, solid = (
            cameras(Options(view=view), Motion(result, [0], Options(), print), 1.0)[0] for view in ("xz", "iso")
        )
        points = result.positions(-1)
        _, symbols = actions.layers(0, points, flat)
        assert len(symbols.lines) == 2 * (3 + 4) + (3 + 1)
        _, symbols = actions.layers(0, points, solid)
        assert len(symbols.lines) == 2 * (3 + 4) + 2 * (3 + 1)
        # each triangle begins at its node, and is 3 % of the diagonal high
        corners = symbols.points.reshape(-1, 2, 3)
        tops = corners[np.isin(np.arange(len(corners)), [0, 7, 11, 15])][:, 0]
        assert {tuple(np.round(top, 6)) for top in tops} <= {tuple(np.round(points[k], 6)) for k in (0, 1, 3)}
        plain = draw(tmp_path / "a", result, frames=[-1], size=(640, 480))
        shown = draw(tmp_path / "b", result, frames=[-1], size=(640, 480), show=["supports", "loads"])
        inks = [len(near(pixels(file)[60:440, :540], (31, 36, 44), 30)[0]) for file in (plain[0], shown[0])]
        assert inks[1] > inks[0] + 80
        with pytest.raises(InputError, match="show = 'weights' is not known; it is one of supports, loads"):
            draw(tmp_path, result, show=["weights"])


def test_removed_supports_have_no_symbols(tmp_path):
    """Let go at 2 ms of the first stage, and gone in the second one, which still names the support."""
    data = {key: CASE[key] for key in ("mesh", "node_set", "material", "section", "output")}
    data["support"] = [{"node_set": "left", "fix": "xyz"}, {"node_set": "right", "fix": "xyz", "name": "bearing"}]
    data["output"] = {"fields_every": 2}
    time = {"integrator": "central_differences", "step": 1e-3, "end": 4e-3}
    data["stage"] = [
        {"name": "let go", "remove": [{"supports": "bearing", "time": 2e-3}], "time": time},
        {"name": "free", "time": time},
    ]
    with Simulation(Case.from_dict(data), output=tmp_path / "result", quiet=True) as simulation:
        simulation.run()
    with open_result(tmp_path / "result") as result:
        assert result.times == pytest.approx([0.0, 2e-3, 4e-3, 6e-3, 8e-3])
        actions = Actions(result, ["supports"], result.times, np.array([[0.0, 0, 0], [2, 1, 1]]))
        camera = camera_of(BOX, "xz")
        drawn = [len(actions.layers(k, result.positions(k), camera)[1].lines) // 7 for k in range(5)]
        assert drawn == [2, 2, 1, 1, 1]


def test_many_loads_are_thinned_and_counted(tmp_path):
    """A square net of 441 loaded nodes has arrows at no more than 40, which cover it evenly."""
    data = {
        "mesh": {"generator": "net", "size": [1.0, 1.0], "cells": [20, 20]},
        "node_set": {"all": {"all": True}},
        "material": {"m": {"young_modulus": 1e9, "density": 1e3}},
        "section": {"s": {"area": 1e-6, "material": "m"}},
        "support": [{"node_set": "all", "fix": "xyz"}],
        "load": [{"node_set": "all", "force": [0.0, 0.0, -1.0]}],
        "time": {"integrator": "central_differences", "step": 1e-7, "end": 1e-7},
    }
    with Simulation(Case.from_dict(data), output=tmp_path / "net", quiet=True) as simulation:
        simulation.run()
    with open_result(tmp_path / "net") as result:
        points = result.positions(0)
        bounds = np.array([points.min(axis=0), points.max(axis=0)])
        actions = Actions(result, ["loads"], result.times[:1], bounds)
        tips = actions.arrows(0, points)[1]
        assert actions.notes == [f"symbols at {len(tips)} of 441 loaded nodes"] and 20 <= len(tips) <= 40
        # nearly as many in each half, and no node farther from one than the diagonal of a cell of 1/5 and half a mesh
        assert all(abs(np.sum(tips[:, k] < 0.499) - np.sum(tips[:, k] > 0.501)) <= 4 for k in (0, 1))
        assert np.linalg.norm(points[:, None] - tips, axis=2).min(axis=1).max() < np.sqrt(2.0) * (0.2 + 0.025)


def test_members_of_each_case_have_a_drawing(loaded, tmp_path):
    """In the order of the cases, whatever that of the table; without, the largest of all."""
    with open_result(loaded) as result:
        bars = f"0-{len(result.bars) - 1}"
        table = Table(
            {
                "bars": np.array([bars] * 3),
                "yield_utilisation": np.array([1.0, 0.2, 0.0]),
                "buckling_utilisation": np.array([np.nan, 0.1, np.nan]),
                "case": np.array(["pull", "both", "push"]),
            }
        )
        full = ColourScale((0.0, 1.0), Options().cmap, "").colours(np.array([1.0]))[0]
        picture = pixels(draw_members(result, table, tmp_path / "each.png", each_case=True))[:, : 1280 - 150]
        rows, columns = near(picture, full, 12)  # of three drawings in two rows, the second is at the upper right
        assert len(rows) > 500 and rows.max() < 0.5 * 720 and columns.min() > 0.5 * 1130
        envelope = pixels(draw_members(result, table, tmp_path / "all.png"))[:, : 1280 - 150]
        assert np.ptp(near(envelope, full, 12)[1]) > 0.5 * 1130
        many = Table({name: np.repeat(table[name], 5) for name in table} | {"case": np.arange(15).astype(str)})
        with pytest.raises(InputError, match="at most 12 drawings, and the table has 15 cases: draw one with case"):
            draw_members(result, many, tmp_path / "many.png", each_case=True)
