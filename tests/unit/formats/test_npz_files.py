"""Arrays of npz files that others wrote: read, or refused before anything is allocated."""

import io
import zipfile

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.formats.archives import read_npz


def written(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            if not isinstance(content, bytes):
                form = io.BytesIO()
                np.lib.format.write_array(form, content, version=(1, 0))
                content = form.getvalue()
            file.writestr(f"{name}.npy", content)
    return path


def header(text):
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 10**12), }\n"),
            "npy array",
        ),
        (header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 100), }\n"), "4073 bytes"),
        (header("[" * 3000 + "]" * 3000), "npy array"),
        (header("__import__('os').system('id')\n"), "npy array"),
        (header("{'descr': '<z9', 'fortran_order': False, 'shape': (1,), }\n"), "z9"),
        (header("{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (1,)}\n"), "plain"),
        (b"", "npy array"),
    ],
)
def test_a_member_that_lies_is_named(tmp_path, content, told):
    path = written(tmp_path / "a.npz", score=content)
    with pytest.raises(InputError, match=told) as caught:
        read_npz(path, 10**6)
    assert caught.value.where == f"{path}: score.npy"
    assert len(str(caught.value)) < 600


def test_arrays_beyond_the_limit_are_not_unpacked(tmp_path):
    path = written(tmp_path / "a.npz", score=np.zeros(1000))
    with pytest.raises(InputError, match="at most 7000 bytes of arrays, found 8128 bytes"):
        read_npz(path, 7000)


def test_a_packed_size_that_is_more_than_the_file_does_not_excuse_a_bomb(tmp_path):
    path = written(tmp_path / "a.npz", a=np.zeros((1 << 20, 9)))
    with pytest.raises(InputError, match="packed at most 200 to 1"):
        read_npz(path, 1 << 30)
    content = bytearray(path.read_bytes())
    directory = content.rindex(b"PK\x01\x02")
    content[directory + 20 : directory + 24] = (1 << 30).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(InputError, match="packed at most 200 to 1"):
        read_npz(path, 1 << 30)


def test_no_archive_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="expected a whole npz file"):
        read_npz(tmp_path / "a.npz", 1000)
