"""Before the evaluation: camera rates, what a recording holds and can observe, its lines."""
