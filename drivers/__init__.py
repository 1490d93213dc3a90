"""The hardware and its stand-ins: servos, cameras, the simulated rover, replay."""
