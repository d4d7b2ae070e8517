"""What tests of several packages share."""

import pytest

from worldpose.body.body_file import load_open_body


@pytest.fixture(scope="session")
def model():
    """The open body model; read only."""
    return load_open_body()
