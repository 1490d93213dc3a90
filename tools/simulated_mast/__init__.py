"""What a simulated rover's mast file costs."""
