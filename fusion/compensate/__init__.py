"""The command `shakercal compensate`: filters that give a sensor the dynamics one wants."""
