"""The sub-commands of `shakercal`."""
