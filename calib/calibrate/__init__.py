"""From measurements to a rig: surveys, benches, still scenes, hand-offs."""
