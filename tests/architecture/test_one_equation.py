"""One camera model, one damping rule and one set of losses: counted in the source."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "worldpose"

HOMES = {
    "geometry/lens_models.py": ("radial", "by_coefficients", "distort", "undistort"),
    "geometry/camera_model.py": ("to_camera_axes", "view", "by_world", "by_rotation", "observe"),
    "geometry/optimize/losses.py": (
        *("cauchy_loss", "cauchy_weight", "geman_mcclure_loss", "geman_mcclure_weight"),
    ),
    "geometry/optimize/levenberg_marquardt.py": ("is_better", "next_damping", "minimize"),
}
SIGNS = {
    # The mixed derivative of a lens, the term that each copy of the derivatives needs.
    r"\bdxy = [^t]|\bgxy\b|slope \* a \* b": "geometry/lens_models.py",
    # The polynomial of a radial lens and its derivative, in place of `radial`.
    r"k2 \+ s \* k3\)|k\[1\] \+ s \* k\[2\]|2\.0 \* k2 \+ 3\.0": "geometry/lens_models.py",
    # A damping that falls after a good step or rises after a bad one.
    r"\bdamping \*= |\bdamping = (max|min)\(|\bdamping / |\bdamping \* course": (
        "geometry/optimize/levenberg_marquardt.py"
    ),
}


def files_with(pattern, root=ROOT):
    expression = re.compile(pattern)
    return sorted(
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if expression.search(path.read_text())
    )


@pytest.mark.parametrize(
    ("name", "home"), [(name, home) for home, names in HOMES.items() for name in names]
)
def test_an_equation_is_defined_once(name, home):
    assert files_with(rf"(?m)^def {name}\(") == [home]


@pytest.mark.parametrize(("sign", "home"), SIGNS.items())
def test_no_other_file_writes_the_equation_again(sign, home):
    assert files_with(sign) == [home]
