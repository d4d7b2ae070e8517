import numpy as np
import pytest

from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import ObservationNoise

TINY = SCENARIOS["tiny"]


@pytest.fixture(scope="module")
def exact():
    return simulate_scene(TINY.model_copy(update={"noise": ObservationNoise.none()}), 1)


def test_without_noise_every_detection_is_its_persons_projection(exact):
    for name, camera in exact.cameras.items():
        people, identity = exact.observations[name], exact.identities[name].person
        assert (identity >= 0).any()
        for frame in range(0, 100, 7):
            for place in np.flatnonzero(identity[frame] >= 0):
                expected = camera.project(exact.truth.joints[frame, identity[frame, place]])
                inside = ((expected >= -0.5) & (expected <= [1919.5, 1079.5])).all(-1)
                expected[~inside] = np.nan
                # float32 holds pixels below 2048 to 2^-14 px = 6e-5.
                np.testing.assert_allclose(
                    people.keypoints[frame, place], expected, atol=6.2e-5, rtol=0
                )


def test_without_noise_everybody_in_the_picture_is_there_and_nobody_else(exact):
    for name, camera in exact.cameras.items():
        pixels = camera.project(exact.truth.joints.reshape(-1, 3)).reshape(100, 5, 17, 2)
        inside = ((pixels >= -0.5) & (pixels <= [1919.5, 1079.5])).all(-1).any(-1)
        identity = exact.identities[name].person
        found = np.stack([(identity == person).sum(axis=1) for person in range(5)], axis=1)
        np.testing.assert_array_equal(found, inside.astype(int))
        assert (np.isfinite(exact.observations[name].score) == (identity >= 0)).all()
