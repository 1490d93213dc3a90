"""The service: configuration, pointing loop, daemon, client and command line."""
