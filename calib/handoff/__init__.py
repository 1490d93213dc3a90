"""From one stereo pair to another camera: predicted, refined by image, and what hand-offs say of the rig."""
