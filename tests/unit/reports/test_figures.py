"""Figures as SVG and PDF, with what they show."""

import json

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from worldpose.geometry.cameras import Camera
from worldpose.reports.drawing import figure_data, note_undrawn_distortion, write_figure


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


def test_distortion_that_a_view_lacks_is_stated():
    lens = np.array([-0.1, 0.02, 0.0, 0.0, 0.0])
    matrix = np.array([[900.0, 0.0, 639.5], [0.0, 900.0, 359.5], [0.0, 0.0, 1.0]])
    bent, plain = (
        Camera.from_matrices(matrix, each, np.eye(3), np.zeros(3), (1280, 720))
        for each in (lens, 0.0 * lens)
    )
    corner = cv2.undistortPoints(np.zeros((1, 1, 2)), matrix, lens, P=matrix)[0, 0]
    said = note_undrawn_distortion({"a": bent, "b": plain})["distortion"]
    assert said.endswith(f"by up to a {np.hypot(*corner):.0f} px")
    assert note_undrawn_distortion({"b": plain}) == {}
