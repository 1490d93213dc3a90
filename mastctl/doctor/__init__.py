"""What a machine lacks for a configuration: permissions, adapters, cameras, clock, disk, mast file."""
