"""Pickles that others wrote, read without running them.

A pickle is a program whose instructions call whatever the file names. Here every name that may come
leads to a class that only notes what it is given, and every other name ends the reading: nothing is
imported, no foreign code runs. `plain` then checks the notes and turns them into arrays, lists and
dictionaries. In: a stream, the names that may come. Out: plain content.
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
