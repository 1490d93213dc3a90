"""Motion: from a request to a residual measured in a new picture, and targets that are followed."""
