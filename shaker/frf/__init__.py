"""Frequency response functions: measuring chains as stated, transfer functions as measured."""
