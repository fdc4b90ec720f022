"""Time base, sines, spectra: from recorded channels to phasors."""
