"""The HTTP interface: routes, what they take, and what stands before them."""
