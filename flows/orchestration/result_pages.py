"""Complete lists from Prefect's API, which returns at most a page per request."""

from __future__ import annotations

from collections.abc import Iterator, Sized
from typing import Final

PAGE: Final = 200
"""Items per page: the maximum of Prefect's server."""


def page_offsets(found: Sized) -> Iterator[int]:
    """Yield the offset of each page, until a page is not full.

    Request pages sorted by id: with equal times, a page may repeat items and omit others. If items
    leave the list between two requests, as many others can be missing until the next look.

    Args:
        found: all items so far; the caller extends it by each page.
    """
    offset = 0
    while True:
        yield offset
        if len(found) < offset + PAGE:
            return
        offset = len(found)
