"""Exception classes. A message says where, what was expected, what was found, and what to do."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Iterable, Mapping
from difflib import get_close_matches


class WorldposeError(Exception):
    """Base class of errors that a user can cause or fix."""


class InputError(WorldposeError):
    """Invalid input.

    Args:
        where: file, and key or position in it: `match.yaml: cameras[2].kind`.
        expected: what is needed there.
        found: what is there instead; the middle of a long text is left out.
        todo: what the user can do about it.
    """

    def __init__(self, where: str, expected: str, found: str, todo: str) -> None:
        self.where, self.expected = _shorten(where), expected
        self.found, self.todo = _shorten(found), todo
        super().__init__(f"{self.where}: expected {expected}, found {self.found}. {todo}")

    def __reduce__(self) -> tuple[object, ...]:
        # Without this the error cannot be unpickled from a worker.
        return type(self), (self.where, self.expected, self.found, self.todo)


def describe_value(value: object) -> str:
    """Return a value of a file for a message, in at most 60 characters."""
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return f"a mapping of {len(value)}"
    text = repr(value)
    if isinstance(value, list | tuple) and len(text) > 60:
        return f"a list of {len(value)}"
    return text if len(text) <= 60 else text[:57] + "..."


def _shorten(text: str) -> str:
    # Maximum characters of the input that a message repeats: a name may have a million.
    max_length = 600
    if len(text) <= max_length:
        return text
    half = max_length // 2 - 20  # leaves room for the text between, so the result is short enough
    return f"{text[:half]}...[{len(text) - 2 * half} characters]...{text[-half:]}"


class UsageError(InputError):
    """A command or setting that does not exist or does not fit."""


def unknown_name(where: str, name: str, known: Iterable[str], todo: str = "") -> UsageError:
    """Return the error for a name of an option, `--clip second`, that is none of the known ones.

    `todo` is by default a similar name, if there is one.
    """
    names = list(known)
    close = get_close_matches(name, names, n=1)
    meant = f"Did you mean {close[0]!r}?" if close else ""
    return UsageError(
        where,
        expected=f"one of {', '.join(names) or '(none)'}",
        found=repr(name),
        todo=" ".join(filter(None, (meant, todo))) or "Choose one of these.",
    )


class DegenerateError(WorldposeError):
    """Geometry that does not determine the result."""


class InternalError(WorldposeError):
    """A bug in worldpose, not in its input.

    Args:
        where: the running code: `triangulation/clip`, or `tracking: array joints[3, 1]`.
        problem: what went wrong, in a programmer's words.
    """

    def __init__(self, where: str, problem: str) -> None:
        self.where, self.problem = where, problem
        super().__init__(
            f"{where}: {problem}. This is a bug in worldpose, not in your data: please report it "
            "with this message and the match."
        )

    @classmethod
    def wrap(cls, where: str, error: BaseException) -> InternalError:
        """Return the error for an unforeseen exception; it names the line that raised it."""
        steps = traceback.extract_tb(error.__traceback__)
        place = ""
        if steps:
            ours = [step for step in steps if "site-packages" not in step.filename]
            step = (ours or list(steps))[-1]
            place = f" at {step.filename}:{step.lineno} in {step.name}"
        return cls(where, f"internal error {type(error).__name__}{place}: {error}")

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.where, self.problem)


class MemoryLimitError(WorldposeError):
    """The system refused memory or a thread."""


def require_memory(failure: BaseException, where: str = "") -> None:
    """Raise MemoryLimitError if a failure of the running code `where` means too little memory."""
    is_thread = isinstance(failure, RuntimeError) and "start new thread" in str(failure)
    is_refused = isinstance(failure, OSError) and failure.errno == errno.ENOMEM
    if isinstance(failure, MemoryError) or is_thread or is_refused:
        said = f"not enough memory ({str(failure) or type(failure).__name__})"
        raise MemoryLimitError(
            f"{where}{': ' if where else ''}{said}: the system refused "
            f"{'a thread' if is_thread else 'a piece of it'}. Free some, raise the limit "
            "(ulimit -v, ulimit -u, or the container's), or use fewer --workers; then run again."
        ) from failure


def say_failure(failure: BaseException) -> str:
    """Return what failed in plain words: no repr, no path, and no advice of another library."""
    if isinstance(failure, OSError) and failure.strerror:
        return failure.strerror
    if isinstance(failure, UnicodeDecodeError):
        return f"bytes that are not {failure.encoding.upper()}, from byte {failure.start} on"
    if isinstance(failure, KeyError):
        return f"no entry {failure.args[0]!r}" if failure.args else "a missing entry"
    text = (str(failure).strip() or "nothing that can be read").splitlines()[0]
    if isinstance(failure, AttributeError | TypeError | IndexError | AssertionError):
        return "values of another kind, or too few"
    return text if len(text) <= 200 else text[:197] + "..."


class StoreError(WorldposeError):
    """The store cannot read or write a result."""


class CorruptionError(StoreError):
    """Stored bytes are not the bytes that were published; `verify` says `todo` by itself."""

    def __init__(self, problem: str, todo: str = "") -> None:
        self.problem = problem
        super().__init__(f"{problem} {todo}".rstrip())


class NondeterminismError(StoreError):
    """One key was computed twice with different bytes."""
