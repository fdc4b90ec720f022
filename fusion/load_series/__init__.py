"""The command `shakercal load`: resonance over the load mass."""
