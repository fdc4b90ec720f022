"""Releases of a load: the record, its models, several loads."""
