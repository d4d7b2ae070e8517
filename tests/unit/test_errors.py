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


def test_an_exception_that_was_never_raised_is_named_all_the_same():
    assert "internal error ValueError: odd" in str(InternalError.wrap("x", ValueError("odd")))


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


def test_a_long_name_is_shortened_in_the_middle():
    error = InputError("m" * 5000, expected="a", found="v" * 999 + "end", todo="Do b.")
    assert len(str(error)) < 1500
    assert "...[442 characters]..." in error.found
    assert error.found.endswith("vend")
    assert InputError("m", expected="a", found="v" * 600, todo="Do b.").found == "v" * 600
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
