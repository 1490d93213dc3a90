"""Does the mast file still hold? Residuals, reference pictures, hand-offs; and figures for watchers."""
