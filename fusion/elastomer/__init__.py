"""The command `shakercal elastomer`: modes of a cross-beam element from its geometry."""
