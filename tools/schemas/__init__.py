"""JSON Schemas of the files that a person writes, taken from the readers themselves."""
