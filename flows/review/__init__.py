"""Review of results by people: verdicts, corrections and acceptance, recorded in the journal."""
