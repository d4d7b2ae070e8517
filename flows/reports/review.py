"""Report section about reviews of the run."""

from __future__ import annotations

from data_contracts.review import Correction, ReviewDecision, ReviewRequest, Withdrawal
from flows.cli.review_text import in_words, when
from flows.stage import Match
from worldpose.reports import Table

MOST = 200
"""Maximum number of rows, the last ones."""


def review_table(match: Match) -> list[Table]:
    """Tabulate verdicts, corrections and withdrawals, first to last; empty without any."""
    units: dict[str, str] = {}
    corrections: dict[str, str] = {}
    rows: list[tuple[str, str, str, str, str]] = []
    for said in match.journal.records:
        if isinstance(said, ReviewRequest):
            units[said.id] = ", ".join(said.keys)
        elif isinstance(said, ReviewDecision):
            verdict = {"approve": "approved", "reject": "rejected"}[said.verdict]
            what = units.get(said.request, said.request)
            rows.append((when(said.decided_at), said.who, verdict, what, said.why or ""))
        elif isinstance(said, Correction):
            corrections[said.id] = in_words(said)
            rows.append(
                (when(said.made_at), said.who, "corrected", in_words(said), str(said.note or ""))
            )
        elif isinstance(said, Withdrawal):
            what = corrections.get(said.correction, said.correction)
            rows.append((when(said.withdrawn_at), said.who, "took back", what, said.why or ""))
    if not rows:
        return []
    left = len(rows) - MOST
    heading = f"The last {MOST}; {left} came before" if left > 0 else ""
    return [Table(heading, ("when", "who", "", "what", "why"), tuple(rows[-MOST:]))]
