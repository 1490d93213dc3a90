"""Boards on paper: the sheet, and its files."""
