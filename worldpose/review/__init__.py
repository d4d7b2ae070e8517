"""Review: verdicts on results, and manual corrections replayed over unchanged output.

Input: the journal of a match in the store, and the content of the match folder. Output: verdicts on
results, corrected clicks and stale corrections.
"""
