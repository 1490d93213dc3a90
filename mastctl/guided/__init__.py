"""A bench calibration that the daemon has carried out for who watches it: by a process of its own."""
