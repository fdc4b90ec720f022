"""Which lines a record has, and which of them sampling can tell apart."""
