"""Safe XML parsing: entity expansion and external references are refused."""

from __future__ import annotations

from typing import Final
from xml.etree import ElementTree
from xml.parsers import expat

from worldpose.formats.annotations.pictures import ContentError

DEEPEST: Final = 16
"""Maximum nesting of elements; annotations have five."""


def read_xml(content: bytes) -> ElementTree.Element:
    """Return the root element of a document without a document type and thus without entities.

    Raises:
        ContentError: it is not XML, declares a document type, or is nested deeply.
    """
    parser, builder = expat.ParserCreate(), ElementTree.TreeBuilder()
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise ContentError(f"elements nested more than {DEEPEST} deep")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise ContentError("a document type declaration, which can hide other files and floods")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(content, True)
    except ContentError:
        raise
    # ValueError and LookupError: an encoding unknown to expat or Python.
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ContentError(f"no XML: {error}") from error
    return builder.close()
