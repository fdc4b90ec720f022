"""The command `shakercal compensate`: a filter from a model, and what it does."""
