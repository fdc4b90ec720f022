"""From a recording folder to the sensitivity with its uncertainty: the only place where images and signals meet."""
