"""Base and options of pan/tilt heads of the broadcast and security world: nothing proves their answers."""
