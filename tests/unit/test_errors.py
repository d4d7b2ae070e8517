"""Messages of errors, and that a bug in worldpose is called one."""

import pickle

import pytest

from worldpose.errors import InputError, InternalError, MemoryLimitError, WorldposeError


def broken():
    return {}["click"]


def test_an_unforeseen_exception_is_called_a_bug_and_names_its_line():
    with pytest.raises(KeyError) as caught:
        broken()
    error = InternalError.wrap("tracking/clip", caught.value)
    assert str(error).startswith("tracking/clip: internal error KeyError at ")
    assert "test_errors.py:11 in broken: 'click'" in str(error)
    assert "This is a bug in worldpose, not in your data" in str(error)


@pytest.mark.parametrize(
    "error",
    [
        InternalError("tracking: array joints[3]", "expected finite numbers only, found nan"),
        InputError("match.yaml: fps", expected="a number", found="'x'", todo="Correct it."),
        MemoryLimitError("tracking/clip: not enough memory"),
    ],
)
def test_errors_travel_back_from_a_worker(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert isinstance(copy, WorldposeError)
    assert str(copy) == str(error)
