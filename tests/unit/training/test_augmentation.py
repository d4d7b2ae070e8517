import numpy as np
import pytest

from worldpose.training.augmentation import AugmentationSettings, augment, draw_clutter

NONE = AugmentationSettings(
    strength=0.0, recoloured=0.0, grey=0.0, fog=0.0, soft=0.0, coded=0.0, grain=0.0
)


def scene(side=64):
    """A bright square on a dark ground."""
    picture = np.full((side, side, 3), 40, dtype=np.uint8)
    picture[20:40, 20:40] = 200
    return picture


def edge(picture):
    """The steepest step of the middle row or column, whichever is less steep [levels]."""
    lines = picture[30, :, 0], picture[:, 30, 0]
    return min(int(np.abs(np.diff(line.astype(int))).max()) for line in lines)


def test_an_image_without_augmentation_stays():
    np.testing.assert_array_equal(augment(scene(), NONE, np.random.default_rng(0)), scene())


@pytest.mark.parametrize("name", ["coarse", "moved"])
def test_a_coarse_sensor_and_motion_soften_edges(name):
    settings = NONE.model_copy(update={name: 1.0})
    edges = [edge(augment(scene(), settings, np.random.default_rng(seed))) for seed in range(20)]
    assert edge(scene()) == 160
    assert max(edges) < 160 and np.mean(edges) < 130


def test_clutter_leaves_people_free():
    people = np.array([[20.0, 20.0, 40.0, 40.0]])
    changed = 0
    for seed in range(20):
        seen = draw_clutter(scene(128), people, np.random.default_rng(seed))
        np.testing.assert_array_equal(seen[20:40, 20:40], scene(128)[20:40, 20:40])
        changed += bool((seen != scene(128)).any())
    assert changed >= 15
