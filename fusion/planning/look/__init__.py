"""A first look at a recording within seconds, before the load mass comes down (`shakercal look`)."""
