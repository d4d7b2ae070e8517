"""Definition of a mutation kind, and the list of all kinds."""

from collections.abc import Callable
from dataclasses import dataclass

KINDS: dict = {}

FILM, DATA, FILES = "film", "data", "files"
"""When a kind strikes: before the cameras film, on clicks and detections, on written files."""


@dataclass(frozen=True)
class Kind:
    """One way to change something that was good.

    Attributes:
        name: of the kind, unique.
        group: camera, clicks, people, clips, ids, pitch, toml, bytes, video, store, request.
        apply: of the draft, or of the project or browser for the last two, and a random generator.
        phase: when it strikes.
        base: the match that it needs: any, clicked, given, filmed, stored.
        harmless: a correct reader gives the right result all the same.
    """

    name: str
    group: str
    apply: Callable
    phase: str = DATA
    base: str = "any"
    harmless: bool = False


def kind(group, *, name=None, phase=DATA, base="any", harmless=False, blind=False):
    """Register a function as a kind of mutation.

    Args:
        group: which.
        name: None takes the function's.
        phase: when it strikes.
        base: the match that it needs.
        harmless: the result must be right.
        blind: the right result is unknown.
    """

    def register(apply):
        def struck(draft, rng):
            apply(draft, rng)
            if blind:
                draft.truth = None

        label = name or apply.__name__
        assert label not in KINDS, label
        KINDS[label] = Kind(label, group, struck, phase, base, harmless)
        return apply

    return register


def kinds(group, values, apply, **options):
    """Register a family: `apply(draft, rng, value)` for each named value."""
    for label, value in values.items():
        kind(group, name=label, **options)(lambda draft, rng, value=value: apply(draft, rng, value))


def one(rng, values):
    """One of the values, by chance."""
    return values[int(rng.integers(len(values)))]


def exchange(content, rng):
    """Exchange the entries of two cameras."""
    if len(content) > 1:
        a, b = rng.choice(list(content), 2, replace=False)
        content[a], content[b] = content[b], content[a]


def drop(content, rng):
    """Remove the entry of one camera."""
    del content[str(rng.choice(list(content)))]
