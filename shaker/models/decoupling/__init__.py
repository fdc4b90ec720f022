"""Several outputs and loads at once: a common model, and the filter that undoes cross-talk."""
