"""Planning before the evaluation: camera rates, observability, lines, drafts, look, view."""
