"""What stands before the routes: server and connections, who comes in, what is refused, what waits.

It knows no route and nothing of what the daemon does.
"""

PREFIX = "/api/v1"
"""Where the routes begin."""
