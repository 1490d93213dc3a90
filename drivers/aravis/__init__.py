"""Industrial cameras of GigE Vision and USB3 Vision: a binding of the library Aravis, and a camera on it."""
