"""From phasors to load and sensitivity, with uncertainty budgets."""
