import pytest

from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid


@pytest.fixture(scope="session", autouse=True)
def _compiled_kernels():
    """Compiles before any test: hypothesis would count those seconds against its deadline."""
    camera = Camera([1.0, 1.0], [0.0, 0.0], [0.1, 0.0, 0.001, 0.0, 0.0], Rigid.identity(), [2, 2])
    camera.unproject(camera.project([[0.0, 0.0, 1.0]]))
    camera.project_with_jacobians([[0.0, 0.0, 1.0]])
