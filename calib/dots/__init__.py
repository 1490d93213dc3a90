"""The dot board in a picture: found, put in order, measured."""
