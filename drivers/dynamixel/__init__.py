"""Heads of two Dynamixel servos (protocol 2.0) with packets of our own that the dynamixel-sdk judges."""
