"""Several outputs and loads at once: common poles, cross-talk and its filter."""
