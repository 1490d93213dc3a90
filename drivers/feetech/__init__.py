"""Heads of two Feetech STS or SMS servos; feetech-servo-sdk judges the packets."""
