"""Immediate assessment of a recording (`shakercal look`)."""
