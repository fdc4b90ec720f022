"""Software validation: frozen cases computed by this installation and compared with references."""
