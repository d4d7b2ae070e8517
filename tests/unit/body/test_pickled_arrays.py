import builtins
import contextlib
import copyreg
import functools
import os
import sys
import threading

import numpy as np
import pytest
import scipy.sparse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from smpl_pickles import Ch, Select, pickled

from worldpose.body.body_file import read_pickled_arrays
from worldpose.errors import InputError

NUMBERS = np.arange(12.0).reshape(3, 4)
_BENIGN_EVENTS = {"open", "builtins.id", "object.__getattr__", "object.__setattr__"}
_events: list[str] | None = None


def _note_event(event, args):
    # Other threads, as of a scheduler that serves other tests, read no pickle here.
    if _events is not None and threading.current_thread() is threading.main_thread():
        _events.append(event)


sys.addaudithook(_note_event)


def read(tmp_path, stream, key="a"):
    """The array, after a check that the interpreter neither imported nor ran anything for it."""
    global _events
    path = tmp_path / "model.pkl"
    path.write_bytes(stream)
    _events = noted = []
    try:
        return read_pickled_arrays(path, (key,))[key]
    finally:
        _events = None
        # Python reports every import, compilation, execution, process, socket and the default
        # resolution of names in pickles as an event.
        assert set(noted) <= _BENIGN_EVENTS


@pytest.fixture(autouse=True)
def warm(tmp_path):
    """Modules that load on first use are imported before events are counted."""
    for protocol in (0, 2):
        stream = pickled({"a": Ch(scipy.sparse.csc_matrix(NUMBERS))}, protocol)
        (tmp_path / "warm.pkl").write_bytes(stream)
        read_pickled_arrays(tmp_path / "warm.pkl", ("a",))


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize(
    "array",
    [
        NUMBERS,
        np.asfortranarray(NUMBERS),
        NUMBERS.astype(">f4"),
        NUMBERS.astype(np.uint32),
        NUMBERS > 3,
        np.array(2.5),
        NUMBERS[::2, ::-1],
    ],
)
def test_arrays_come_as_they_were(tmp_path, array, protocol):
    back = read(tmp_path, pickled({"a": array}, protocol))
    np.testing.assert_array_equal(back, array)
    assert back.dtype == array.dtype


@pytest.mark.parametrize("protocol", [0, 2])
def test_chumpy_is_read_without_chumpy(tmp_path, protocol):
    assert "chumpy" not in sys.modules
    np.testing.assert_array_equal(read(tmp_path, pickled({"a": Ch(NUMBERS)}, protocol)), NUMBERS)
    picked = Select(Ch(NUMBERS), np.array([11, 0, 5, 6]), (2, 2))
    np.testing.assert_array_equal(
        read(tmp_path, pickled({"a": picked}, protocol)), [[11.0, 0.0], [5.0, 6.0]]
    )
    nested = Ch(Ch(NUMBERS))
    np.testing.assert_array_equal(read(tmp_path, pickled({"a": nested}, protocol)), NUMBERS)


def test_a_pickle_of_python_2_is_read(tmp_path):
    # What Python 2 wrote for {"a": numpy.array([1.0, 2.0])}: names of old, bytes as text.
    stream = (
        b"\x80\x02}q\x00U\x01aq\x01cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\n"
        b"q\x03K\x00\x85q\x04U\x01bq\x05\x87q\x06Rq\x07(K\x01K\x02\x85q\x08cnumpy\ndtype\nq\x09"
        b"U\x02f8q\x0aK\x00K\x01\x87q\x0bRq\x0c(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xff"
        b"K\x00tb\x89U\x10" + np.array([1.0, 2.0]).tobytes() + b"tq\x0dbs."
    )
    np.testing.assert_array_equal(read(tmp_path, stream), [1.0, 2.0])


class Payload:
    """Pickles as a call of anything."""

    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


def payloads(canary):
    command = f"touch {canary}"
    write = f"open({str(canary)!r}, 'w')"
    return {
        "os.system": Payload(os.system, command),
        "eval": Payload(eval, write),
        "import": Payload(builtins.__import__, "antigravity"),
        "getattr": Payload(getattr, "text", "upper"),
        "partial": functools.partial(os.system, command),
        "reconstructor": Payload(copyreg._reconstructor, dict, dict, {}),
        "numpy": Payload(np.fromfile, str(canary)),
    }


@pytest.mark.parametrize("name", list(payloads("")))
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_a_pickle_that_calls_something_is_refused_and_calls_nothing(tmp_path, name, protocol):
    canary = tmp_path / "canary"
    payload = payloads(canary)[name]
    hidden = {
        "alone": payload,
        "beside": {"a": NUMBERS, "b": payload},
        "in a list": {"a": [payload]},
        "in chumpy": {"a": Ch(payload)},
        "in an array": {"a": np.array([payload, None], dtype=object)},
    }
    for content in hidden.values():
        with pytest.raises(InputError, match="cannot be read as a pickle"):
            read(tmp_path, pickled(content, protocol))
        assert not canary.exists()


@pytest.mark.parametrize(
    "stream",
    [
        # A name inside an allowed module, and a path to a function inside an allowed class.
        b"\x80\x04\x8c\x05numpy\x8c\x08fromfile\x93\x8c\x01x\x85R.",
        b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__reduce__\x93)R.",
        b"\x80\x04\x8c\x08builtins\x8c\x0fobject.__class__\x93)R.",
        # The old instructions that make an instance: INST and OBJ.
        b"(S'true'\nios\nsystem\n.",
        b"(cos\nsystem\nS'true'\no.",
        # Numbers of registered extensions, and persistent objects.
        b"\x80\x02\x82\x01.",
        b"Pname\n.",
        # Setting attributes of a stand-in class, and of an instance through slots.
        b"cnumpy\ndtype\n}S'args'\nI1\nsb.",
        b"cnumpy\ndtype\n)RN}S'__class__'\nI1\ns\x86b.",
        # _reconstructor of something that is no class of the file.
        b"ccopy_reg\n_reconstructor\n(I1\nI2\nNtR.",
        # Memory: a memorised object far beyond the file, and an array of a terabyte.
        b"Nr\xff\xff\xff\xff.",
        b"\x8e\x00\x00\x00\x00\x00\x01\x00\x00.",
    ],
)
def test_handmade_streams_are_refused(tmp_path, stream):
    with pytest.raises(InputError):
        read(tmp_path, stream)


@pytest.mark.parametrize(
    "content",
    [
        {"a": 1.0},
        {"a": "text"},
        {"a": np.array(["text"])},
        {"a": np.array([None])},
        {"a": np.array("2020-01-01", dtype="M8[D]")},
        {"a": np.float64(1.0)},
        {"a": Select(NUMBERS, np.array([100]), (1,))},
        {"a": Select(NUMBERS, np.array([1]), (7,))},
        {"b": NUMBERS},
        NUMBERS,
    ],
)
def test_what_is_no_array_is_refused(tmp_path, content):
    with pytest.raises(InputError):
        read(tmp_path, pickled(content))


def spoiled_contents():
    """Streams of arrays whose parts contradict each other, with what the error tells."""
    outside = scipy.sparse.csc_matrix(NUMBERS)
    outside.indices[-1] = 1_000_000
    backwards = scipy.sparse.csc_matrix(NUMBERS)
    backwards.indptr[1:-1], backwards.indptr[-1] = 1_000_000_000, 0
    endless = Ch(None)
    endless.x = endless
    short = pickled({"a": np.frombuffer(b"\x11" * 24)})
    assert short.count(b"K\x03\x85") == 1
    return [
        (short.replace(b"K\x03\x85", b"K\x04\x85"), "24 bytes for the shape"),
        (pickled({"a": outside}), "indices"),
        (pickled({"a": backwards}), "end before they begin"),
        (pickled({"a": scipy.sparse.csc_matrix((1_000_000, 1_000_000))}), "a sparse matrix of sh"),
        (pickled({"a": endless}), "contains itself"),
    ]


@pytest.mark.parametrize(("stream", "told"), spoiled_contents())
def test_an_array_whose_parts_contradict_each_other_is_refused(tmp_path, stream, told):
    with pytest.raises(InputError, match=told):
        read(tmp_path, stream)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_streams_run_nothing(tmp_path, data):
    stream = bytearray(pickled({"a": Ch(NUMBERS[:1]), "b": scipy.sparse.csc_matrix(NUMBERS)}))
    for _ in range(data.draw(st.integers(1, 4))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(InputError):
        read(tmp_path, bytes(stream))
