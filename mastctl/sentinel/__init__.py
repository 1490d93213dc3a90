"""The drift sentinel: reference pictures at a few rests, looked at again, and what has changed named."""
