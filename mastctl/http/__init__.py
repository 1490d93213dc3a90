"""The checks before the routes: the client of a request, refusals, and requests that wait.

The package knows no route and nothing of the daemon's work.
"""

PREFIX = "/api/v1"
"""Where the routes begin."""
