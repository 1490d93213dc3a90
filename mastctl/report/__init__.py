"""Pages and pictures: how results are shown."""
