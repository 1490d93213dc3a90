"""The head and the cameras as the service uses them: threads, deadlines, checks, limits."""
