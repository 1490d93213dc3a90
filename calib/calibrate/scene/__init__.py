"""Pictures of a still scene at many angles, and what they tell of cameras, axes and joints."""
