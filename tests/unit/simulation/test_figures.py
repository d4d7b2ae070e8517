import numpy as np
import pytest

from worldpose.body import BodyParameters
from worldpose.simulation.figures import draw_figure


@pytest.fixture(scope="module")
def figures():
    rng = np.random.default_rng(2)
    return [draw_figure((1.70, 1.95), rng) for _ in range(60)]


def test_figures_are_as_tall_as_they_say(figures):
    for figure in figures[:8]:
        surface = figure.model.vertices(BodyParameters(figure.betas, *map(np.zeros, (3, 69, 3))))
        # Crown and sole are fixed vertices; another may be a little higher or lower.
        assert np.ptp(surface[:, 1]) == pytest.approx(figure.height, abs=0.003)
        assert surface[:, 1].min() == pytest.approx(figure.sole, abs=0.003)
    heights = np.array([figure.height for figure in figures])
    assert heights.min() >= 1.70
    assert heights.max() <= 1.95
    assert np.ptp(heights) > 0.2


def test_figures_of_one_height_differ_in_build():
    rng = np.random.default_rng(0)
    alike = [draw_figure((1.8, 1.8), rng) for _ in range(40)]
    shoulders = np.array([np.linalg.norm(f.joints[16] - f.joints[17]) for f in alike])
    legs = np.array([np.linalg.norm(f.joints[1] - f.joints[7]) for f in alike])
    # MakeHuman's people vary little in their proportions: some percent, and half a percent.
    assert 0.01 < shoulders.std() / shoulders.mean() < 0.05
    assert 0.004 < legs.std() / legs.mean() < 0.02


def test_figures_have_human_proportions(figures):
    for figure in figures:

        def length(a, b, figure=figure):
            return np.linalg.norm(figure.joints[a] - figure.joints[b]) / figure.height

        # Winter, Biomechanics and Motor Control of Human Movement: 0.245 and 0.246 of the height;
        # other hips and other people account for 5 %.
        assert length(1, 4) == pytest.approx(0.245, abs=0.012)
        assert length(4, 7) == pytest.approx(0.246, abs=0.012)
        assert 0.03 < figure.toe < 0.08
        assert 0.03 < figure.heel < 0.08


def test_a_figures_joints_are_its_models(figures):
    figure = figures[0]
    rest = BodyParameters(figure.betas, *map(np.zeros, (3, 69, 3)))
    np.testing.assert_allclose(figure.joints, figure.model.joints(rest), atol=1e-14)
