"""What a daemon does, and which client may have it do that: its state, operations, commands, leases."""
