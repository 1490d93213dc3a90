"""What the tests notice: small changes of the code, drawn at random; the nearest tests should object."""
