"""One time base for all records: edges, triggers, clock ties."""
