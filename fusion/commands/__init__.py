"""The sub-commands of `shakercal`, one module each; heavy modules are imported when a command acts."""
