"""Real data of tests: what WORLDPOSE_TEST_DATA has, and the mark of tests that need some of it."""

import os
from pathlib import Path

import pytest

GIVEN = Path(os.environ.get("WORLDPOSE_TEST_DATA", "absent"))


def needs(*names):
    """Skips a test where a folder or file of these names is absent."""
    absent = " and ".join(name for name in names if not (GIVEN / name).exists())
    return pytest.mark.skipif(bool(absent), reason=f"WORLDPOSE_TEST_DATA has no {absent}")
