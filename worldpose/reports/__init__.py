"""Reports: HTML pages, plots, overlays and videos.

Drawing modules import matplotlib; `html_page` and `run_report` do not.
"""
