"""Whether pointings still come out as the mast file predicts."""
