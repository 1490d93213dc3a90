"""Where a fit begins, from rough focal lengths alone."""
