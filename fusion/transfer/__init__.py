"""Transfer functions between channels: `shakercal transfer`."""
