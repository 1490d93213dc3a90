"""Pictures of a still scene at many angles, as measurements of cameras, axes and joints."""
