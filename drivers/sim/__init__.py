"""The simulated rover: a true rig, true servos and a true scene, which the service never reads."""
