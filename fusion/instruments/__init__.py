"""The kinds of instruments: rows of the model, errors by name and drawn, unit, what can be observed."""
