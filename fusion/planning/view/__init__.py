"""`shakercal view`: a local page of images, channels, spectra and phasors, too large for a report."""
