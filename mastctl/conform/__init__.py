"""What a daemon, a head or a camera promises, asked of any of them: checks that pytest and a command run."""
