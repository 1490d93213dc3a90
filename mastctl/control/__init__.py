"""What a daemon does, and who may have it do what: its state, operations, commands, leases."""
