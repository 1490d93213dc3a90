"""Heads of two servos on one bus, whatever their packets: line, thread, axis, session and head."""
