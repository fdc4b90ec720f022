"""The elastic element."""
