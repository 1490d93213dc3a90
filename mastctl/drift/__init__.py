"""Whether the mast file is still valid: residuals, hand-offs, reference images, seams; one verdict."""
