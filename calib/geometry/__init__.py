"""Cameras of the CAHV family, two revolute axes, and what follows from them: pixels, points, joint angles."""
