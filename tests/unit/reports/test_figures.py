"""Figures as SVG and PDF, with what they show."""

import json

import numpy as np
import pytest
from matplotlib.figure import Figure

from worldpose.reports.drawing import figure_data, keep_figures, png, write_figure


@pytest.fixture
def figure():
    drawn = Figure(figsize=(3.0, 2.0))
    axes = drawn.subplots()
    axes.set(title="clocks", xlabel="time [s]", ylabel="offset [frames]")
    axes.plot([0.0, 1.0, 2.0], [1.0, np.nan, 1.23456789], label="cam00")
    axes.scatter([4.0], [5.0])
    axes.bar([10.0], [3.0], width=2.0)
    axes.quiver([1.0], [2.0], [0.5], [-0.5])
    axes.fill_between([0.0, 1.0], [0.0, 0.0], [1.0, 1.0], label="region")
    axes.imshow(np.zeros((4, 6)), extent=(0.0, 1.0, 0.0, 1.0))
    axes.annotate("kick", (1.5, 2.5))
    return drawn


def test_the_data_are_the_numbers_that_were_drawn(figure):
    (panel,) = figure_data(figure)
    assert (panel["title"], panel["x"], panel["y"]) == ("clocks", "time [s]", "offset [frames]")
    found = {each["kind"]: each for each in panel["series"]}
    assert len(found) == len(panel["series"]) == 7
    assert found["line"] == {
        "kind": "line",
        "label": "cam00",
        "x": [0.0, 1.0, 2.0],
        "y": [1.0, None, 1.234568],
    }
    assert (found["points"]["x"], found["points"]["y"]) == ([4.0], [5.0])
    assert found["bar"] == {"kind": "bar", "x": [9.0], "y": [0.0], "width": [2.0], "height": [3.0]}
    arrows = [found["arrows"][name] for name in ("x", "y", "dx", "dy")]
    assert arrows == [[1.0], [2.0], [0.5], [-0.5]]
    assert found["areas"]["label"] == "region"
    assert {(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (None, None)} == set(
        zip(found["areas"]["x"], found["areas"]["y"], strict=True)
    )
    assert (found["image"]["width"], found["image"]["height"]) == (6, 4)
    assert found["text"] == {"kind": "text", "text": "kick", "x": [1.5], "y": [2.5]}


def test_areas_have_the_value_of_their_colour():
    drawn = Figure()
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 20), np.linspace(0.0, 1.0, 20))
    drawn.subplots().contourf(x, y, x, levels=[0.0, 0.5, 1.0])
    ((areas,),) = [panel["series"] for panel in figure_data(drawn)]
    pairs = zip(areas["x"], areas["value"], strict=True)
    at = {value: [x for x, v in pairs if v == value] for value in (0.25,)}
    assert at[0.25] and max(at[0.25]) <= 0.5 + 1e-6
    assert 0.75 in areas["value"]


def test_files_are_equal_for_equal_figures_and_text_stays_text(figure, tmp_path):
    first = write_figure(figure, tmp_path / "a", "two clocks, cam00 ± 1")
    again = write_figure(figure, tmp_path / "b", "two clocks, cam00 ± 1")
    assert [path.name for path in first] == ["a.svg", "a.pdf", "a.json"]
    for one, other in zip(first, again, strict=True):
        assert one.read_bytes() == other.read_bytes()
    svg, pdf, data = first
    assert ">offset [frames]<" in svg.read_text()
    assert pdf.read_bytes().startswith(b"%PDF-")
    shown = json.loads(data.read_text())
    assert shown["caption"] == "two clocks, cam00 ± 1"
    assert shown["panels"] == figure_data(figure)


def test_figures_are_kept_only_where_it_is_asked_for(figure):
    png(figure)
    with keep_figures() as kept:
        drawn = png(figure)
    png(figure)
    assert kept == {drawn: figure}
