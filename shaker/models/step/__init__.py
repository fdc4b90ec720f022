"""Records of step responses: where the step is, how it was released, what their spectrum shows."""
