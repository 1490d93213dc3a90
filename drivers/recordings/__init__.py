"""Recordings: what is in them, and a head and cameras that show it again."""
