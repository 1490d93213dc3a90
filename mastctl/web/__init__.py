"""The HTTP interface: routes, what they take, and what stands before them."""

PREFIX = "/api/v1"
"""Where its routes begin."""
