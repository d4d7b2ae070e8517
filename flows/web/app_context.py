"""Shared context of all pages: the project and access control."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, HTTPException, Request

from flows.registering import open_for_review
from flows.stage import Match
from flows.web.access import Access
from flows.web.continuing import Continuing
from worldpose.store import Store


@dataclass(frozen=True)
class Desk:
    """Shared context of all pages.

    Attributes:
        store: the project.
        access: access control.
        continuing: runs started or resumed from a page.
    """

    store: Store
    access: Access
    continuing: Continuing = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "continuing", Continuing(self.store))

    def match(self, name: str) -> Match:
        """Return a registered match with its current corrections.

        Raises:
            HTTPException: 404; a name from outside never becomes a path.
        """
        if name not in self.store.matches():
            raise HTTPException(404, "no such match")
        return open_for_review(self.store, name)


def _person(request: Request) -> str:
    return str(request.state.who)


Person = Annotated[str, Depends(_person)]
"""Logged-in person: the guard refuses requests without one."""
