"""The sensor as a mechanical system, from transfer functions and sensitivities: `shakercal identify`."""
