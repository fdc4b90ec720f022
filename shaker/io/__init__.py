"""Channels from the files of data acquisition systems."""
