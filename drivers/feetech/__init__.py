"""Heads of two Feetech STS, SMS or SCS servos; feetech-servo-sdk judges the packets."""
