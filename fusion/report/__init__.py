"""Pages, figures, tables and result files."""
