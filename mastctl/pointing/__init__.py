"""The pointing loop: from a request to a residual measured in a new picture."""
