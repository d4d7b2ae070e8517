"""A disk that does not answer, as over a network that is gone."""

import ctypes
import os
from contextlib import contextmanager, suppress

import pytest


@contextmanager
def stalled(folder):
    """Mount over a folder what never answers, until the end; without the right to, skip."""
    system, path, device = ctypes.CDLL(None), os.fsencode(folder), -1
    with suppress(OSError):
        device = os.open("/dev/fuse", os.O_RDWR)
    options = f"fd={device},rootmode=40000,user_id={os.getuid()},group_id={os.getgid()}"
    if device < 0 or system.mount(b"stalled", path, b"fuse", 0, options.encode()):
        pytest.skip("no right to mount")
    try:
        yield
    finally:
        os.close(device)  # all that wait for it get an error
        system.umount2(path, 2)
