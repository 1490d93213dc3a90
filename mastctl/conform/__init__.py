"""What a rig promises through its daemon: the checks of ``mastctl conform``."""
