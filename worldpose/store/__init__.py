"""Content-addressed store of results: written atomically, verified on read, never overwritten.

Input: arrays that match a layout of `data_contracts`, and the recipe that they were computed by.
Output: labelled arrays, the runs that used them, and the reasons for differences between results.
"""
