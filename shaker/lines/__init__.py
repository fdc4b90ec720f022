"""Lines of a record, and rates that separate them."""
