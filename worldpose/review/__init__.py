"""Review: verdicts on results, and manual corrections replayed over unchanged output.

Input: the journal of a match in the store, and the content of the match folder. Output: verdicts on
results, corrected clicks and stale corrections.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.review.clicks import (
        Replay,
        add_previous_value,
        current_value,
        replay_corrections,
    )
    from worldpose.review.journal import (
        Journal,
        append,
        last_decision,
        read_journal,
        requests_by_id,
        say,
    )

__all__ = [
    "Journal",
    "Replay",
    "add_previous_value",
    "append",
    "current_value",
    "last_decision",
    "read_journal",
    "replay_corrections",
    "requests_by_id",
    "say",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.review.clicks": (
            "Replay",
            "add_previous_value",
            "current_value",
            "replay_corrections",
        ),
        "worldpose.review.journal": (
            "Journal",
            "append",
            "last_decision",
            "read_journal",
            "requests_by_id",
            "say",
        ),
    },
)
