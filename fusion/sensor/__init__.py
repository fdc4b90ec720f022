"""The sensor as a mechanical system: one folder per command."""
