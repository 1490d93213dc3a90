"""V4L2 cameras: our own thin layer on the kernel's interface, and a camera that knows when it exposed."""
