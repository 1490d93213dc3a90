"""A head calibrated on a bench by pictures of boards that stood anywhere."""
