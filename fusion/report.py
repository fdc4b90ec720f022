"""report.html: one self-contained page."""
REPORT_FILE = "report.html"
