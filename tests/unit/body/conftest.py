from dataclasses import replace

import numpy as np
import pytest

from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyParameters


@pytest.fixture(scope="session")
def open_body():
    return load_open_body()


@pytest.fixture(scope="session")
def corrected_body(open_body):
    """The open body with made-up pose correctives of 5 mm, the part it lacks of SMPL's layout."""
    rng = np.random.default_rng(5)
    directions = 0.005 * rng.normal(size=(len(open_body.template), 3, 207)).astype(np.float32)
    return replace(open_body, pose_directions=directions)


@pytest.fixture
def people():
    """Five differently shaped people in wild poses, tens of metres from the origin."""
    rng = np.random.default_rng(1)
    return BodyParameters(
        betas=rng.normal(size=(5, 10)),
        global_orient=rng.normal(size=(5, 3)),
        body_pose=0.6 * rng.normal(size=(5, 69)),
        transl=30.0 * rng.normal(size=(5, 3)),
    )
