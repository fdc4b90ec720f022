"""What a single resonance shows: its readings and its fit."""
