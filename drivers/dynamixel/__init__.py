"""Heads of two Dynamixel servos (protocol 2.0) over the dynamixel-sdk's port and packet layers, hardened."""
