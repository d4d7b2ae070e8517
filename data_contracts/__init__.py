"""Records that cross a stage border or reach disk, and the layouts of stored arrays.

Nothing here computes; nothing here imports project code.
"""
