"""Reports: HTML pages, plots, overlays and videos.

Drawing modules import matplotlib; `html_page` and `run_report` do not.
"""

from worldpose.reports.html_page import CaptionedImage, EmbeddedPage, LinkedFile, Section, Table
from worldpose.reports.run_report import CameraSummary, report_page

__all__ = [
    "CameraSummary",
    "CaptionedImage",
    "EmbeddedPage",
    "LinkedFile",
    "Section",
    "Table",
    "report_page",
]
