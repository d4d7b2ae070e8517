"""Messages for people in a browser: what they can do there, in place of commands of a terminal."""

from __future__ import annotations

import re
from typing import Final

from worldpose.errors import InputError

_COMMAND: Final = re.compile(
    r"\bworldpose (?P<command>[a-z][a-z-]+)|(?<![\w-])--[a-z][a-z-]*|\bpip install\b"
)
_ASIDE: Final = re.compile(r" \(worldpose [a-z-]+[^()]*\)")
"""A command that a sentence adds to what it says."""
_SENTENCE: Final = re.compile(r"(?<=[.!?]) +")
_ON_PAGES: Final = {
    "run": "Run the match on its page.",
    "review": "The page of the match shows what waits.",
    "ingest": "Put the match folder into the inbox, or ask the operator to register it.",
    "status": "The status page lists all runs.",
}
"""Actions of pages in place of commands."""
_ELSE: Final = "Ask the operator of this service."


def in_browser(text: str) -> str:
    """Return a message in which each sentence with a command says what a page offers instead."""
    said: list[str] = []
    for sentence in _SENTENCE.split(_ASIDE.sub("", text)):
        found = _COMMAND.search(sentence)
        if found is None:
            said.append(sentence)
            continue
        instead = _ON_PAGES.get(found["command"] or "", _ELSE)
        if instead not in said:
            said.append(instead)
    return " ".join(said)


def describe_error(error: Exception) -> str:
    """Return the message of an error; where, expected and found of wrong input always stay."""
    if not isinstance(error, InputError):
        return in_browser(str(error))
    what = f"{error.where}: expected {error.expected}, found {error.found}."
    return f"{what.replace('`', '').replace('--', '')} {in_browser(error.todo)}"
