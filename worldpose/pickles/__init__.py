"""Safe reading of untrusted pickles, without executing them.

A pickle is a program whose instructions call any function that the file names. Here every allowed
name maps to a class that only records its arguments, and any other name aborts the reading: nothing
is imported, no foreign code runs. `plain` then checks the recorded notes and converts them to
arrays, lists and dictionaries. Input: a stream, the allowed names. Output: plain content.
"""

from worldpose.pickles.notes import (
    ALLOWED,
    LARGEST,
    Dtype,
    Kind,
    Note,
    numbers,
    plain,
    type_of,
)
from worldpose.pickles.unpickler import Unpickler, no_storage

__all__ = [
    "ALLOWED",
    "LARGEST",
    "Dtype",
    "Kind",
    "Note",
    "Unpickler",
    "no_storage",
    "numbers",
    "plain",
    "type_of",
]
