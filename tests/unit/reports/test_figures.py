"""Figures as SVG and PDF, with what they show."""

import json

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from worldpose.reports.drawing import (
    GRASS,
    WIDTH,
    figure_data,
    keep_figures,
    picture_panels,
    png,
    show_image,
    write_figure,
)


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


def coded_places(height, width):
    """An image whose colours tell the place: red from the left, green from the top."""
    image = np.full((height, width, 3), 90, dtype=np.uint8)
    image[..., 0] = np.linspace(0, 255, width)
    image[..., 1] = np.linspace(0, 255, height)[:, None]
    return image


def drawn(figure):
    pixels = cv2.imdecode(np.frombuffer(png(figure), np.uint8), cv2.IMREAD_COLOR)
    return pixels[..., ::-1].astype(int)


@pytest.mark.parametrize("across", [3080.0, 1540.0, 308.0])
def test_a_picture_is_shown_at_its_places_in_every_size(across):
    side = across * np.array([1.0, 900.0 / 1540.0])
    corner = np.zeros(2) if across > 3000.0 else np.array([700.0, 400.0])
    still = coded_places(1800, 3080)
    shown = drawn(picture_panels(["whole"], corner - 0.5, side, still=still)[0])
    top = shown.shape[0] - 900
    assert shown.shape[1] == WIDTH
    assert 0 < top < 60
    for x, y in [(20, 30), (770, 450), (1500, 880)]:
        u, v = (corner + (np.array([x, y]) + 0.5) * across / WIDTH).astype(int)
        np.testing.assert_allclose(shown[top + y, x], still[v, u], atol=2)


def test_a_picture_of_the_figure_s_resolution_is_copied():
    still = np.random.default_rng(5).integers(0, 255, (300, 1600, 3)).astype(np.uint8)
    shown = drawn(picture_panels(["part"], (39.5, 19.5), (1540.0, 200.0), still=still)[0])
    np.testing.assert_array_equal(shown[-195:-5, 5:-5], still[25:215, 45:1575])


def test_beyond_the_picture_there_is_plain_ground():
    still = coded_places(100, 200)
    figure, (axes,) = picture_panels(["edge"], (150.0, 50.0), (100.0, 100.0), still=still)
    shown = drawn(figure)
    ground = (np.array(to_rgb(GRASS)) * 255).round()
    np.testing.assert_allclose(shown[-20, -20], ground, atol=1)
    np.testing.assert_allclose(shown[-1520, 20], still[51, 151], atol=2)
    assert not picture_panels(["off"], (300.0, 0.0), (50.0, 50.0), still=still)[1][0].images
    assert len(axes.images) == 1


def test_panels_stand_side_by_side_and_show_the_same_part():
    still = coded_places(540, 960)
    figure, panels = picture_panels(["left", "right"], (-0.5, -0.5), (960, 540), still=still)
    shown = drawn(figure)
    width = (WIDTH - 14) // 2
    assert [axes.get_title(loc="left") for axes in panels] == ["left", "right"]
    np.testing.assert_array_equal(shown[60:-5, 5 : width - 5], shown[60:-5, width + 19 : -5])


def test_a_grey_picture_is_grey_and_goes_into_vector_files(tmp_path):
    figure, (axes,) = picture_panels(["grey"], (-0.5, -0.5), (200, 100))
    show_image(axes, coded_places(100, 200)[..., 0])
    shown = drawn(figure)[60:-5, 5:-5]
    assert (shown.max(-1) == shown.min(-1)).all() and np.ptp(shown) > 240
    svg, pdf, _ = write_figure(figure, tmp_path / "a", "grey")
    assert "data:image/png" in svg.read_text() and b"/Image" in pdf.read_bytes()
