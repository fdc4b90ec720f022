"""Models of an elastic element: formulas, frame and solid."""
