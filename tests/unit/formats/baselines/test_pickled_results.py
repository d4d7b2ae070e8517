"""Files of methods are read, and nothing in them is run."""

import os
import pickle
import zlib
from collections import OrderedDict, defaultdict

import joblib
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.formats.baselines.result import read_pickled

rng = np.random.default_rng(0)
CONTENT = {
    "plain": rng.normal(size=(3, 4)).astype(np.float32),
    "columns": np.asfortranarray(rng.normal(size=(3, 2))),
    "swapped": np.arange(3, dtype=">i4"),
    "text": np.array(["ab", "c"]),
    "empty": np.empty((0, 2)),
    3: [1, 2.5, "s", None, True, np.int64(4), (1, 2)],
    (0, 1): OrderedDict(x=np.array(True)),
}


def same(found):
    for name in ("plain", "columns", "swapped", "text", "empty"):
        assert np.array_equal(found[name], CONTENT[name]), name
        assert found[name].shape == CONTENT[name].shape
    assert found[3] == [1, 2.5, "s", None, True, 4, [1, 2]]
    assert found[0, 1]["x"]


class Hostile:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


@pytest.mark.parametrize("compress", [0, 3, ("gzip", 3)])
def test_joblib_files_give_what_joblib_wrote(compress, tmp_path):
    content = defaultdict(dict)
    content[np.int64(1)]["again"] = content[2] = CONTENT
    joblib.dump(content, tmp_path / "a.pkl", compress=compress)
    found = read_pickled(tmp_path / "a.pkl").value
    same(found[1]["again"])
    same(found[2])


@pytest.mark.parametrize("form", ["zip", "older", "pickle", "numpy"])
def test_torch_tensors_give_their_numbers(form, tmp_path):
    torch = pytest.importorskip("torch")
    base = torch.arange(24.0).reshape(4, 6)
    content = {"turned": base.T, "part": base[1:, ::2], "whole": torch.arange(3), "one": base[0, 3]}
    path = tmp_path / "a"
    if form == "zip":
        torch.save(content, path)
    elif form == "older":
        torch.save(content, path, _use_new_zipfile_serialization=False)
    elif form == "pickle":
        path.write_bytes(pickle.dumps(content))
    else:
        path = tmp_path / "a.npy"
        np.save(path, content)
    if form == "older":  # methods write it only within other files
        with pytest.raises(InputError, match="expected results of a method"):
            read_pickled(path)
        return
    found = read_pickled(path).value
    for name, tensor in content.items():
        assert np.array_equal(found[name], tensor.numpy()), name


@pytest.mark.parametrize("writer", ["joblib", "torch", "numpy"])
def test_file_that_names_code_is_refused_and_nothing_runs(writer, tmp_path):
    trace, path = tmp_path / "ran", tmp_path / "a.npy"
    content = {"a": np.ones(3), "b": Hostile(trace)}
    if writer == "joblib":
        joblib.dump(content, path)
    elif writer == "torch":
        pytest.importorskip("torch").save(content, path)
    else:
        np.save(path, content)
    with pytest.raises(InputError, match=r"the name \w+\.system, which is not allowed.*was run"):
        read_pickled(path)
    assert not trace.exists()


def pushed(module, name, *values):
    """A pickle that calls a name with values, without what is needed to write it."""
    body = b"".join(pickle.dumps(value, 2)[2:-1] for value in values)
    return b"\x80\x02c" + f"{module}\n{name}\n".encode() + b"(" + body + b"tR."


@pytest.mark.parametrize(
    "content",
    [
        pushed("numpy", "ndarray.tofile", "x"),
        pushed("torch.storage", "_load_from_bytes", b"cposix\nsystem\n(S'true'\ntR."),
        pushed("torch._utils", "_rebuild_tensor_v2", 1, 0, (1,), (1,)),
        b"\x80\x02]}X\x01\x00\x00\x00aK\x01sb.",  # a state set on a list
        zlib.compress(pickle.dumps(CONTENT))[:-9],
        b"",
        pickle.dumps(CONTENT)[:-20],
    ],
)
def test_damaged_and_malicious_files_give_one_clear_error(content, tmp_path):
    (tmp_path / "a.pkl").write_bytes(content)
    with pytest.raises(InputError, match="expected results of a method"):
        read_pickled(tmp_path / "a.pkl")


def test_tensor_beyond_its_storage_is_refused(tmp_path):
    torch = pytest.importorskip("torch")
    torch.save({"a": torch.arange(4.0)}, tmp_path / "a.pt")
    import zipfile

    with zipfile.ZipFile(tmp_path / "a.pt") as file:
        parts = {name: file.read(name) for name in file.namelist()}
    name = next(name for name in parts if name.endswith("data.pkl"))
    # The length 4 in the tensor's shape becomes 100: 'K\x04\x85' is (4,).
    assert parts[name].count(b"K\x04\x85") == 1
    parts[name] = parts[name].replace(b"K\x04\x85", b"Kd\x85")
    with zipfile.ZipFile(tmp_path / "b.pt", "w") as file:
        for member, content in parts.items():
            file.writestr(member, content)
    with pytest.raises(InputError, match=r"lengths \[100\] on 4 numbers"):
        read_pickled(tmp_path / "b.pt")
