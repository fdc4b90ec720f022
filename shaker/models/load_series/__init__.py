"""Load characteristics: stiffness, damping and resonances of a sensor over the mass it carries."""
