"""Software validation: frozen cases computed by this installation, against results of other means."""
