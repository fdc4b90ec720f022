"""The version of the program."""

__version__ = "0.2.0"  # as in pyproject.toml: reading the installed one takes long
