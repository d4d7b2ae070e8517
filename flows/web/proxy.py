"""Login by a proxy in front of the pages, such as oauth2-proxy: it names the person and groups."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_address
from typing import Annotated, Final, Literal

from pydantic import Field, StringConstraints, model_validator
from starlette.datastructures import Headers
from starlette.types import Scope

from data_contracts.records import Record

TOKEN_LENGTH: Final = 16
"""Minimum length of a chosen token [characters]."""
NAME_LENGTH: Final = 80
"""Maximum length of a person's name [characters]."""

Role = Literal["viewer", "annotator", "approver"]
"""viewer: sees all; annotator: also corrects; approver: also decides, runs and adds matches."""
ROLES: Final[tuple[Role, ...]] = ("viewer", "annotator", "approver")
"""Each allows all that the one before it allows."""

HeaderName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9-]+$")]


@dataclass(frozen=True)
class Visitor:
    """Person whom a trusted proxy has logged in.

    The role is the highest of the person's groups, None if no group has one; `secure` says whether
    the browser speaks TLS with the proxy.
    """

    who: str
    role: Role | None
    secure: bool


class Proxy(Record):
    """Table [proxy] of a file of users: the proxy that logs people in, and the roles of groups."""

    addresses: tuple[IPv4Network | IPv6Network, ...] = Field(min_length=1)
    """Addresses or networks of the proxy; headers of any other client are ignored."""
    secret: str | None = Field(default=None, min_length=TOKEN_LENGTH)
    """Value of the header `X-Proxy-Secret`; required with an address of this machine, at which
    every account of the machine can pretend to be the proxy."""
    user: HeaderName = "X-Forwarded-User"
    """Header with the person's name."""
    groups: HeaderName = "X-Forwarded-Groups"
    """Header with the person's groups, separated by commas."""
    roles: dict[str, Role] = Field(min_length=1)
    """Group to role; the highest of a person's groups counts."""
    sign_out: str = Field(default="/", pattern=r"^/[^/\\]*(/[^/\\]+)*$")
    """Path at the proxy that ends its session, as `/oauth2/sign_out`."""

    @model_validator(mode="after")
    def _needs_secret(self) -> Proxy:
        if self.secret is None and any(each.is_loopback for each in self.addresses):
            raise ValueError("a proxy on this machine needs a secret: any account could be it")
        return self

    def visitor(self, scope: Scope, headers: Headers) -> Visitor | None:
        """Return the person whom the proxy names; None if the request is not the proxy's."""
        address, _ = scope.get("client") or ("", 0)
        names, given = headers.getlist(self.user), headers.getlist("x-proxy-secret")
        if len(names) != 1 or not self._is_proxy(address, given):
            return None
        who = _text(names[0])
        if not who.isprintable() or not 0 < len(who) <= NAME_LENGTH:
            return None
        listed = ",".join(_text(each) for each in headers.getlist(self.groups))
        found = {self.roles.get(group.strip()) for group in listed.split(",")}
        role = max((each for each in found if each is not None), key=ROLES.index, default=None)
        return Visitor(who, role, headers.get("x-forwarded-proto", "").lower() == "https")

    def _is_proxy(self, address: str, given: list[str]) -> bool:
        try:
            peer = ip_address(address)
        except ValueError:
            return False
        if not any(peer in network for network in self.addresses):
            return False
        if self.secret is None:
            return True
        right = self.secret.encode()
        return len(given) == 1 and hmac.compare_digest(given[0].encode("latin-1"), right)


def _text(header: str) -> str:
    """Return a header's UTF-8 text, which ASGI takes for Latin-1; empty if it is none."""
    try:
        return header.encode("latin-1").decode("utf-8")
    except UnicodeError:
        return ""
