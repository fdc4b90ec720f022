"""Dynamic calibration of multi-component force and moment sensors: the public names of the program."""
