"""Interactive view of a recording and its results (`shakercal view`)."""
