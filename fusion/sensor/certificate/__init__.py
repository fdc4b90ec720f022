"""The calibration certificate: as XML for programs (Digital Calibration Certificate) and as a page for people."""
