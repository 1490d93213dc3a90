"""Pan/tilt heads of the broadcast world that speak VISCA, over a serial line or a raw TCP port."""
